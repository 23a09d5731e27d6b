"""Map file schema: the arrays, their consistency checks, and information about a map derived from them.

This module does not need the estimator, so that ``lumiloop map info`` loads no compiler.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import Any, Final

import msgspec
import numpy as np
import numpy.typing as npt

from daemon.maps.container import AnyArray, BadMap, Damaged, unpack
from estimator import Lamp, Survey

Tables = dict[str, AnyArray]
Keys = npt.NDArray[np.int64]

KINDS: Final[dict[str, tuple[str, int]]] = {
    "meta": ("|u1", 0),
    "submap.key": ("<i8", 0),
    "submap.first": ("<i8", 0),
    "submap.map": ("<f8", 3),
    "submap.odom": ("<f8", 3),
    "submap.way": ("<f8", 0),
    "submap.sigma": ("<f8", 0),
    "submap.elements": ("<i8", 0),
    "submap.witness": ("<i8", 0),
    "submap.seen": ("<f8", 3),
    "submap.lit": ("|u1", 0),
    "submap.light": ("<f8", 12),
    "element": ("<f4", 8),
    "joined.keys": ("<i8", 2),
    "joined.T": ("<f8", 3),
    "joined.H": ("<f8", 6),
    "joined.loop": ("|u1", 0),
    "frame.key": ("<i8", 0),
    "frame.submap": ("<i8", 0),
    "frame.T": ("<f8", 3),
    "frame.mount": ("<f8", 3),
    "frame.turned": ("<f8", 0),
    "frame.fan": ("<i8", 0),
    "frame.exact": ("|u1", 0),
    "frame.lit": ("|u1", 0),
    "frame.light": ("<f8", 12),
    "frame.lamps": ("<i8", 0),
    "frame.lamp": ("<i8", 0),
    "fan.beams": ("<i8", 0),
    "fan.bearing": ("<f8", 0),
    "range.mm": ("<i4", 0),
    "range.m": ("<f4", 0),
    "beam": ("|u1", 0),
    "lamp.id": ("<i8", 2),
    "lamp": ("<f8", 8),
    "gain.id": ("<i8", 0),
    "gain": ("<f8", 6),
    "sensor": ("<f8", 9),
    "pose": ("<f8", 3),
    "pose.P": ("<f8", 3),
}
"""Arrays of version 1: dtype and columns. docs/maps.md describes each."""

AWAY_M: Final = 0.3
"""Distance in m by which a lamp may differ from its earlier position; a larger one means another or a moved lamp."""
SAME_SHARE: Final = 0.5
"""Smallest share of common lamps of two surveys; below it the map belongs to another building or frame."""
LAST_SHARE: Final = 0.25
"""Smallest share of the submaps with which the part of the robot's last position is chosen from a split map."""


class OtherBuilding(BadMap):
    """The map was made with the survey of another building."""

    remedy = (
        "name the survey of this map in `lights.survey`, or another `map.folder`; the command RESET begins a new map"
    )


class Meta(msgspec.Struct, frozen=True):
    """Metadata of a map.

    Attributes:
        map_id, name, surveyed, survey, session: see `estimator.mapping.map_snapshot.Identity`. saved: seconds of UTC.
        robot: name in the configuration. software: version that wrote the file.
    """

    map_id: int
    name: str = ""
    surveyed: bool = False
    survey: str = ""
    session: int = 0
    saved: float = 0.0
    robot: str = ""
    software: str = ""

    def packed(self) -> AnyArray:
        """The metadata as an array of the file."""
        return np.frombuffer(msgspec.json.encode(self), np.uint8)


@dataclass(frozen=True, slots=True, eq=False)
class Stored:
    """Content of a map file after all checks.

    Attributes:
        isolated: submaps removed because no edge connects them with the rest.
    """

    meta: Meta
    tables: Tables
    isolated: int = 0


def read(content: bytes) -> Stored:
    """Decode and check a map file; of a map in several parts, one is returned (:func:`main_part`).

    Raises:
        BadMap: it cannot be used; the text states the reason.
    """
    tables = unpack(content, KINDS)
    meta = _meta(tables)
    check(tables)
    keep = main_part(tables)
    if keep.all():
        return Stored(meta, tables)
    return Stored(meta, only(tables, keep), int(np.sum(~keep)))


def _meta(tables: Tables) -> Meta:
    try:
        return msgspec.json.decode(tables["meta"].tobytes(), type=Meta)
    except (KeyError, ValueError, msgspec.DecodeError) as error:
        raise Damaged(f"the part `meta` has no valid map identity ({error})") from None


def check(tables: Tables) -> None:
    """Check that the arrays are those of a map and consistent with each other.

    Raises:
        Damaged: names the array.
    """
    for name, (dtype, columns) in KINDS.items():
        if name not in tables:
            raise Damaged(f"the part `{name}` is missing")
        array = tables[name]
        if array.dtype.str != dtype or (array.shape[1] if array.ndim == 2 else 0) != columns:
            raise Damaged(f"the part `{name}` has the wrong shape")
        if dtype in ("<f8", "<f4") and name != "range.m" and not np.isfinite(array).all():
            raise Damaged(f"the part `{name}` contains a value that is not a number")
    n = {name: len(tables[name]) for name in KINDS}
    for name in KINDS:
        kind = name.partition(".")[0]
        rows = {"submap": "submap.key", "frame": "frame.key", "joined": "joined.keys"}.get(kind)
        if rows is not None and name not in ("submap.light", "frame.light", "frame.lamps", "frame.lamp"):
            _must(n[name] == n[rows], name)
    keys, frames, t = tables["submap.key"], tables["frame.key"], tables
    _must(bool((np.diff(keys) > 0).all()) and (n["submap.key"] == 0 or keys[0] > 0), "submap.key")
    _must(len(np.unique(frames)) == len(frames) and bool((frames > 0).all()), "frame.key")
    _must(bool(np.isin(t["joined.keys"], keys).all()), "joined.keys")
    _must(bool((t["joined.keys"][:, 0] != t["joined.keys"][:, 1]).all()), "joined.keys")
    _must(bool(np.isin(t["frame.submap"], np.append(keys, 0)).all()), "frame.submap")
    _must(_within(t["submap.witness"], n["frame.key"]), "submap.witness")
    _must(_adds_up(t["submap.elements"], n["element"]), "submap.elements")
    _must(bool((t["submap.sigma"] > 0.0).all()), "submap.sigma")
    _must(bool((t["beam"] <= 2).all()), "beam")
    _check_scans(tables, n)
    _must(n["submap.light"] == int(np.sum(t["submap.lit"] != 0)), "submap.light")
    _must(n["frame.light"] == n["frame.lamps"] == int(np.sum(t["frame.lit"] != 0)), "frame.light")
    _must(_adds_up(t["frame.lamps"], n["frame.lamp"]), "frame.lamps")
    _must(n["lamp"] == n["lamp.id"], "lamp")
    _must(n["gain"] == n["gain.id"], "gain")
    _must(bool((t["gain"][:, 3:] > 0.0).all()), "gain")
    _must(n["sensor"] in (0, 2) and bool((t["sensor"][1:] >= 0.0).all()), "sensor")
    _must(n["pose"] == 1 and n["pose.P"] == 3, "pose")


def _check_scans(tables: Tables, n: dict[str, int]) -> None:
    fans, fan = tables["fan.beams"], tables["frame.fan"]
    _must(_adds_up(fans, n["fan.bearing"]), "fan.beams")
    _must(_within(fan, len(fans)), "frame.fan")
    beams, exact = fans[fan], tables["frame.exact"] != 0
    _must(int(beams.sum()) == n["beam"], "beam")
    _must(int(beams[exact].sum()) == n["range.mm"], "range.mm")
    _must(int(beams[~exact].sum()) == n["range.m"], "range.m")


def _must(true: bool, name: str) -> None:
    if not true:
        raise Damaged(f"the part `{name}` is inconsistent with the others")


def _within(index: AnyArray, count: int) -> bool:
    return bool(((index >= 0) & (index < count)).all())


def _adds_up(counts: AnyArray, total: int) -> bool:
    return bool(((counts >= 0) & (counts <= total)).all()) and int(counts.sum()) == total


def parts(tables: Tables) -> Keys:
    """Connected component of the pose graph for each submap, as a number.

    Submaps with a light solution share one frame, the survey's, which connects them too.
    """
    keys = tables["submap.key"]
    lit = np.flatnonzero(tables["submap.lit"])
    ends = np.vstack((np.searchsorted(keys, tables["joined.keys"]), np.column_stack((lit[:-1], lit[1:]))))
    part = np.arange(len(keys))
    while True:
        least = part.copy()
        np.minimum.at(least, ends[:, 0], part[ends[:, 1]])
        np.minimum.at(least, ends[:, 1], part[ends[:, 0]])
        least = least[least]
        if np.array_equal(least, part):
            return part
        part = least


def main_part(tables: Tables) -> npt.NDArray[np.bool_]:
    """Mask of the submaps of the component with the robot's last position, or else of the largest one."""
    part = parts(tables)
    if len(part) == 0:
        return np.ones(0, np.bool_)
    counts = np.bincount(part)
    last = part[-1]
    chosen = last if counts[last] >= LAST_SHARE * len(part) else int(np.argmax(counts))
    return np.asarray(part == chosen)


def only(tables: Tables, keep: npt.NDArray[np.bool_]) -> Tables:
    """The tables reduced to some of the submaps and their entries; scans keep their indices."""
    keys, t = tables["submap.key"], tables
    kept = dict(tables)
    lit = t["submap.lit"] != 0
    kept["submap.light"] = t["submap.light"][keep[lit]]
    kept["element"] = t["element"][np.repeat(keep, t["submap.elements"])]
    for name in KINDS:
        if name.startswith("submap.") and name != "submap.light":
            kept[name] = t[name][keep]
    joins = np.isin(t["joined.keys"], keys[keep]).all(axis=1)
    for name in ("joined.keys", "joined.T", "joined.H", "joined.loop"):
        kept[name] = t[name][joins]
    kept["frame.submap"] = np.where(np.isin(t["frame.submap"], keys[keep]), t["frame.submap"], 0)
    return kept


def lamps_of(tables: Tables) -> tuple[Lamp, ...]:
    """Surveyed lamps at the time of saving."""
    rows = zip(tables["lamp.id"].tolist(), tables["lamp"].tolist(), strict=True)
    return tuple(Lamp(lamp_id, code, *numbers) for (lamp_id, code), numbers in rows)


def lamp_tables(lamps: tuple[Lamp, ...]) -> Tables:
    """The inverse of :func:`lamps_of`."""
    rows = [
        (lamp.x, lamp.y, lamp.z, lamp.power_w, lamp.order, lamp.slope_x, lamp.slope_y, lamp.sigma_ln) for lamp in lamps
    ]
    ids = [(lamp.lamp_id, lamp.code) for lamp in lamps]
    return {"lamp.id": np.array(ids, "<i8").reshape(-1, 2), "lamp": np.array(rows, "<f8").reshape(-1, 8)}


def digest_of(survey: Survey) -> str:
    """Digest of a survey; empty for one without lamps."""
    return hashlib.sha256(msgspec.json.encode(survey)).hexdigest() if survey.lamps else ""


def against_survey(stored: Stored, survey: Survey) -> tuple[str, frozenset[int]]:
    """Changes of the survey since the map was made: as text, and the lamps concerned; both empty without changes.

    Raises:
        OtherBuilding: the two have next to nothing in common.
    """
    digest = digest_of(survey)
    if not digest or not stored.meta.survey or digest == stored.meta.survey:
        return "", frozenset()
    then = {lamp.lamp_id: lamp for lamp in lamps_of(stored.tables)}
    now = {lamp.lamp_id: lamp for lamp in survey.lamps}
    common = then.keys() & now.keys()
    moved = {k for k in common if then[k].code != now[k].code or _apart(then[k], now[k]) > AWAY_M}
    same = len(common) - len(moved)
    if same < SAME_SHARE * min(len(then), len(now)) or same == 0:
        raise OtherBuilding(
            f"the map was made with another survey: {same} of its {len(then)} lamps agree with the present one"
        )
    other = {k for k in common if then[k] != now[k]} - moved
    gone, new = then.keys() - now.keys(), now.keys() - then.keys()
    words = [
        f"{what}: {', '.join(map(str, sorted(which)[:8]))}{', ...' if len(which) > 8 else ''}"
        for what, which in (("moved", moved), ("gone", gone), ("new", new), ("with another power", other))
        if which
    ]
    said = "; ".join(words) or "none, but the receiver or the diffuse floor"
    return f"the survey has changed since, lamps {said}", frozenset(moved | gone | other)


def _apart(a: Lamp, b: Lamp) -> float:
    return math.hypot(a.x - b.x, a.y - b.y, a.z - b.z)


def summary(stored: Stored) -> dict[str, Any]:
    """Summary of a map for display."""
    meta, t = stored.meta, stored.tables
    at = t["submap.map"][:, :2]
    reach = [0.0, 0.0] if len(at) == 0 else np.ptp(at, axis=0).round(1).tolist()
    return {
        "map_id": meta.map_id,
        "name": meta.name,
        "frame": "the light survey's" if meta.surveyed else "its own",
        "robot": meta.robot,
        "software": meta.software,
        "saved": meta.saved,
        "sessions": meta.session,
        "submaps": len(t["submap.key"]),
        "isolated_submaps": stored.isolated,
        "keyframes": int(np.sum(t["frame.submap"] != 0)),
        "elements": len(t["element"]),
        "loops": int(np.sum(t["joined.loop"] != 0)),
        "extent_m": reach,
        "lamps": len(t["lamp"]),
        "learned_gains": len(t["gain"]),
        "last_pose": [round(value, 4) for value in t["pose"][0].tolist()],
    }
