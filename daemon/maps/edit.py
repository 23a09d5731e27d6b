"""Map file editing: rigid motion of the frame, or a new name, written as the next generation.

This module does not load the estimator's compiler.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
import numpy.typing as npt

from daemon.config.paths import stored_maps
from daemon.config.schema import Config
from daemon.maps.container import MOST_BYTES, BadMap, pack
from daemon.maps.generations import said
from daemon.maps.schema import Meta, Stored, Tables, read
from daemon.maps.store import Store
from daemon.system.atomic_file import write_whole
from daemon.system.regular_file import read_named

Array = npt.NDArray[np.float64]

LONGEST_NAME: Final = 64
BESIDE: Final = "stop the daemon, or use --out FILE, copy the file there and run `lumiloop switch-map FILE`"
"""Remedy where the folder of a new map is in use."""
LEAST_APART_M: Final = 1.0
"""Smallest distance of two points in m that determines a rotation."""
TOLERANCE_M, TOLERANCE = 0.1, 0.01
"""Tolerances of a point (m) and of the scale: the accuracy of measurements with a tape."""


class Refused(Exception):
    """The change is not possible; the text states the reason and the remedy."""


@dataclass(frozen=True, slots=True)
class Fit:
    """A rigid motion of the map.

    Attributes:
        T: (x, y, yaw), the map's old frame in the new one. residual_m: of each point. scale: distances in the new frame
            over those in the old one, 1 where they agree.
    """

    T: tuple[float, float, float]
    residual_m: tuple[float, ...]
    scale: float


def opened(path: Path) -> Stored:
    """Read and check a map file.

    Raises:
        OSError: it cannot be read. BadMap: it cannot be used. Both name the file and the remedy.
    """
    try:
        return read(read_named(path, MOST_BYTES))
    except OSError as error:
        raise OSError(f"{path}: cannot read the map: {said(error)}; name a map file, *.lumimap") from error
    except BadMap as error:
        raise type(error)(f"{path}: {error}; {error.advice}") from error


def put(path: Path, content: bytes) -> Path:
    """Write a map to a path that the operator chose; `OSError` contains the path and the remedy."""
    try:
        write_whole(path, content)
    except OSError as error:
        raise OSError(f"{path}: cannot write the map: {said(error)}; name another file with --out FILE") from error
    return path


def keep(settings: Config, content: bytes, map_id: int) -> Path:
    """Store a map in the configured folder; `OSError`, with the remedy, where another process uses it."""
    if not settings.map.kept:
        raise OSError("`map.folder` is none; name a file with --out FILE")
    store = Store(stored_maps(settings.map.folder))
    try:
        return store.save(content, map_id)
    except OSError as error:
        raise OSError(f"{store.folder}: {said(error)}; {BESIDE}") from error
    finally:
        store.close()


def called(text: str) -> str:
    """Check the text as a map name and return it.

    Raises:
        Refused: it is not permitted.
    """
    text = text.strip()
    if len(text) > LONGEST_NAME or not text.isprintable():
        raise Refused(f"a name must be one line of at most {LONGEST_NAME} characters")
    return text


def written(path: Path, out: Path | None, tables: Tables, meta: Meta) -> Path:
    """Write a changed map of ``path`` to ``out``, else as the next generation beside it; return its path."""
    content = pack({**tables, "meta": msgspec.structs.replace(meta, saved=time.time()).packed()})
    read(content)  # a map that cannot be read again is not written
    if out is not None:
        return put(out, content)
    store = Store(path.parent)
    try:
        return store.save(content, meta.map_id)
    except OSError as error:
        raise Refused(f"{path.parent}: {said(error)}; stop the daemon, or name --out FILE") from error
    finally:
        store.close()


def pair_of(text: str) -> tuple[float, float, float, float]:
    """Parse ``X,Y=X',Y'`` into four numbers, m.

    Raises:
        Refused: wrong syntax.
    """
    sides = [side.split(",") for side in text.split("=")]
    try:
        numbers = [float(part) for side in sides for part in side]
    except ValueError:
        numbers = []
    if [len(side) for side in sides] != [2, 2] or len(numbers) != 4 or not all(map(math.isfinite, numbers)):
        raise Refused(f"--point {text}: expected X,Y=X',Y' in metres, the coordinates in the map and the correct ones")
    a, b, c, d = numbers
    return a, b, c, d


def fitted(pairs: list[tuple[float, float, float, float]]) -> Fit:
    """Least-squares rigid motion that maps the first points to the second ones (Arun et al. 1987).

    Raises:
        Refused: fewer than two points, or all in one place.
    """
    if len(pairs) < 2:
        raise Refused("at least two points are needed, far apart: --point X,Y=X',Y' --point ...")
    a, b = np.array(pairs)[:, :2], np.array(pairs)[:, 2:]
    p, q = a - a.mean(axis=0), b - b.mean(axis=0)
    wide_p, wide_q = float(np.hypot(*np.ptp(a, axis=0))), float(np.hypot(*np.ptp(b, axis=0)))
    if min(wide_p, wide_q) < LEAST_APART_M:
        raise Refused(
            f"the points lie within {min(wide_p, wide_q):.2f} m; use points {LEAST_APART_M:g} m apart or more"
        )
    yaw = math.atan2(float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum()), float((p * q).sum()))
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array(((c, -s), (s, c)))
    x, y = (b.mean(axis=0) - R @ a.mean(axis=0)).tolist()
    off = np.hypot(*(a @ R.T + (x, y) - b).T)
    scale = math.sqrt(float((q * q).sum()) / float((p * p).sum()))
    return Fit((x, y, yaw), tuple(off.tolist()), scale)


def judge(fit: Fit) -> None:
    """Check that the point pairs belong to one rigid body.

    Raises:
        Refused: their distances disagree.
    """
    worst = int(np.argmax(fit.residual_m))
    if abs(fit.scale - 1.0) > TOLERANCE or fit.residual_m[worst] > TOLERANCE_M:
        raise Refused(
            f"the distances of the points differ by {100.0 * (fit.scale - 1.0):+.1f} %, and point {worst + 1} "
            f"has a residual of {fit.residual_m[worst]:.2f} m; measure again, errors must be within "
            f"{100.0 * TOLERANCE:g} % and {TOLERANCE_M:g} m"
        )


def moved(tables: Tables, T: tuple[float, float, float]) -> Tables:
    """The map with all poses in its frame transformed by T."""
    after = dict(tables)
    for key in ("submap.map", "pose"):
        after[key] = shifted(tables[key], T)
    for key in ("submap.light", "frame.light"):
        after[key] = np.column_stack((shifted(tables[key][:, :3], T), turned(tables[key][:, 3:], T[2])))
    after["pose.P"] = turned(tables["pose.P"].reshape(-1, 9), T[2]).reshape(-1, 3)
    after["lamp"] = tables["lamp"].copy()
    after["lamp"][:, :2] = shifted(np.column_stack((tables["lamp"][:, :2], np.zeros(len(tables["lamp"])))), T)[:, :2]
    return after


def shifted(poses: Array, T: tuple[float, float, float]) -> Array:
    """Poses (n, 3) in the new frame."""
    x, y, yaw = T
    c, s = math.cos(yaw), math.sin(yaw)
    u, v, w = np.asarray(poses).T
    w = np.mod(w + yaw + np.pi, 2.0 * np.pi) - np.pi
    return np.column_stack((x + c * u - s * v, y + s * u + c * v, w))


def turned(P: Array, yaw: float) -> Array:
    """Covariances, (n, 9) in row-major order, rotated to the axes of the new frame."""
    c, s = math.cos(yaw), math.sin(yaw)
    R = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    return np.asarray(R @ P.reshape(-1, 3, 3) @ R.T).reshape(-1, 9)
