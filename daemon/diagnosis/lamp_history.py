"""Lamp history: gain of each lamp day by day, collected from the daemon's maps into a file that lasts for years.

Maps are few, and newer ones replace them; this file keeps one line per lamp and day. It is text: UTC in seconds, lamp
ID, ln of the power over the surveyed power, and its sigma.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from daemon.maps.container import MOST_BYTES, BadMap
from daemon.maps.schema import read
from daemon.maps.store import Store
from daemon.system.atomic_file import write_whole
from daemon.system.regular_file import read_regular

DAY_S: Final = 86_400.0
KEPT_S: Final = 5 * 365 * DAY_S
HEAD: Final = "utc,lamp,ln_gain,sigma\n"
DIGITS: Final = 5
"""Decimals of the stored values."""


@dataclass(frozen=True, slots=True, order=True)
class Look:
    """Gain of a lamp at a time: ``utc`` in s, ``ln_gain`` of its power over the surveyed one, and its ``sigma``."""

    utc: float
    lamp: int
    ln_gain: float
    sigma: float


class BadHistory(Exception):
    """The file cannot be read; the text gives the line and the remedy."""


def load(path: Path) -> list[Look]:
    """Returns all entries, oldest first; empty without a file.

    Raises:
        BadHistory: it is not a lamp history.
        OSError: it cannot be read.
    """
    if not path.exists():
        return []
    lines = path.read_text(errors="replace").splitlines()
    if not lines or lines[0] + "\n" != HEAD:
        raise BadHistory(f"{path} is not a lamp history: its first line is not `{HEAD.strip()}`; name another file")
    looks = []
    for number, line in enumerate(lines[1:], 2):
        try:
            utc, lamp, gain, sigma = line.split(",")
            look = Look(float(utc), int(lamp), float(gain), float(sigma))
        except ValueError:
            raise BadHistory(f"{path}, line {number}: `{line[:60]}` is not a valid line; remove it") from None
        if not all(map(math.isfinite, (look.utc, look.ln_gain))) or not 0.0 < look.sigma < 1e3:
            raise BadHistory(f"{path}, line {number}: `{line[:60]}` is out of range; remove it")
        looks.append(look)
    return sorted(looks)


def save(path: Path, looks: Iterable[Look]) -> None:
    """Writes the file, whole or not at all; raises `OSError`."""
    lines = [f"{look.utc:.0f},{look.lamp},{look.ln_gain:.{DIGITS}f},{look.sigma:.{DIGITS}f}\n" for look in looks]
    write_whole(path, (HEAD + "".join(lines)).encode())


def in_maps(folder: Path) -> list[Look]:
    """Returns the entries of the maps in a folder, without unusable maps (`lumiloop map verify` gives the cause).

    Raises:
        OSError: the folder cannot be read.
    """
    looks = []
    for generation in Store(folder, mend=False).generations():
        try:
            stored = read(read_regular(generation.path, MOST_BYTES))
        except (BadMap, OSError):
            continue
        if stored.meta.saved <= 0.0:
            continue  # the clock of its computer was not set
        gains = stored.tables["gain"]
        for lamp, row in zip(stored.tables["gain.id"].tolist(), gains.tolist(), strict=True):
            looks.append(_as_kept(stored.meta.saved, int(lamp), row[0], math.sqrt(row[3])))
    return looks


def _as_kept(utc: float, lamp: int, ln_gain: float, sigma: float) -> Look:
    """Returns an entry rounded as in the file, so that rounding does not make a constant value change."""
    return Look(float(round(utc)), lamp, round(ln_gain, DIGITS), max(round(sigma, DIGITS), 10.0**-DIGITS))


def merged(kept: Sequence[Look], fresh: Sequence[Look]) -> list[Look]:
    """Returns the latest entry of each lamp and day, not older than :data:`KEPT_S` before the newest."""
    latest: dict[tuple[int, int], Look] = {}
    for look in sorted((*kept, *fresh)):
        latest[look.lamp, int(look.utc // DAY_S)] = look
    looks = sorted(latest.values())
    return [look for look in looks if look.utc >= looks[-1].utc - KEPT_S]


def by_lamp(looks: Sequence[Look]) -> dict[int, np.ndarray[tuple[int, int], np.dtype[np.float64]]]:
    """Returns the rows (utc, ln_gain, sigma) of each lamp, oldest first."""
    lamps = sorted({look.lamp for look in looks})
    return {lamp: np.array([(one.utc, one.ln_gain, one.sigma) for one in looks if one.lamp == lamp]) for lamp in lamps}
