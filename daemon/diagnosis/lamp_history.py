"""How strong each lamp was, day by day: learned by the daemon, kept in its maps, gathered into a file that lasts.

Maps are few, and are replaced by newer ones; one line a lamp and day is kept here for years. The file is text: UTC in
seconds, lamp ID, ln of the power against the survey, its deviation.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from daemon.maps.container import BadMap
from daemon.maps.schema import read
from daemon.maps.store import Store
from daemon.system.atomic_file import write_whole

DAY_S: Final = 86_400.0
KEPT_S: Final = 5 * 365 * DAY_S
HEAD: Final = "utc,lamp,ln_gain,sigma\n"
DIGITS: Final = 5
"""Of what is kept, behind the point."""


@dataclass(frozen=True, slots=True, order=True)
class Look:
    """What was known of a lamp at a time: ``ln_gain`` of its power against the survey, ``sigma`` of that."""

    utc: float
    lamp: int
    ln_gain: float
    sigma: float


class BadHistory(Exception):
    """The file cannot be read; the text says where, and what to do."""


def load(path: Path) -> list[Look]:
    """All that is kept, oldest first; empty where there is no file.

    Raises:
        BadHistory: it is no such file.
        OSError: it cannot be read.
    """
    if not path.exists():
        return []
    lines = path.read_text(errors="replace").splitlines()
    if not lines or lines[0] + "\n" != HEAD:
        raise BadHistory(f"{path} is no history of lamps: its first line is not `{HEAD.strip()}`; name another file")
    looks = []
    for number, line in enumerate(lines[1:], 2):
        try:
            utc, lamp, gain, sigma = line.split(",")
            look = Look(float(utc), int(lamp), float(gain), float(sigma))
        except ValueError:
            raise BadHistory(f"{path}, line {number}: `{line[:60]}` is no line of it; take it out") from None
        if not all(map(math.isfinite, (look.utc, look.ln_gain))) or not 0.0 < look.sigma < 1e3:
            raise BadHistory(f"{path}, line {number}: `{line[:60]}` cannot be; take it out")
        looks.append(look)
    return sorted(looks)


def save(path: Path, looks: Iterable[Look]) -> None:
    """Write it whole or not at all; raises `OSError`."""
    lines = [f"{look.utc:.0f},{look.lamp},{look.ln_gain:.{DIGITS}f},{look.sigma:.{DIGITS}f}\n" for look in looks]
    write_whole(path, (HEAD + "".join(lines)).encode())


def in_maps(folder: Path) -> list[Look]:
    """What the maps in a folder say; one that cannot be used is passed over, `lumiloop map verify` says why.

    Raises:
        OSError: the folder cannot be read.
    """
    looks = []
    for generation in Store(folder, mend=False).generations():
        try:
            stored = read(generation.path.read_bytes())
        except (BadMap, OSError):
            continue
        if stored.meta.saved <= 0.0:
            continue  # its computer did not know the time
        gains = stored.tables["gain"]
        for lamp, row in zip(stored.tables["gain.id"].tolist(), gains.tolist(), strict=True):
            looks.append(_as_kept(stored.meta.saved, int(lamp), row[0], math.sqrt(row[3])))
    return looks


def _as_kept(utc: float, lamp: int, ln_gain: float, sigma: float) -> Look:
    """As the file has it, to the last digit: a value that stands still must not seem to move by being rounded."""
    return Look(float(round(utc)), lamp, round(ln_gain, DIGITS), max(round(sigma, DIGITS), 10.0**-DIGITS))


def merged(kept: Sequence[Look], fresh: Sequence[Look]) -> list[Look]:
    """Both, the latest of each lamp and day, and not older than :data:`KEPT_S` before the newest."""
    latest: dict[tuple[int, int], Look] = {}
    for look in sorted((*kept, *fresh)):
        latest[look.lamp, int(look.utc // DAY_S)] = look
    looks = sorted(latest.values())
    return [look for look in looks if look.utc >= looks[-1].utc - KEPT_S]


def by_lamp(looks: Sequence[Look]) -> dict[int, np.ndarray[tuple[int, int], np.dtype[np.float64]]]:
    """By lamp: rows (utc, ln_gain, sigma), oldest first."""
    lamps = sorted({look.lamp for look in looks})
    return {lamp: np.array([(one.utc, one.ln_gain, one.sigma) for one in looks if one.lamp == lamp]) for lamp in lamps}
