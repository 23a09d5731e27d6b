"""Real drives spoiled as robots in the field spoil theirs: each kind by itself, at random from a seed."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import Final

import numpy as np

from tools.experiments.belief.logs import Drive
from tools.sim.building.world import Array

Rng = np.random.Generator
Spoil = Callable[[Drive, Rng], None]

STAMP_S, RANGE_M, DROPPED = 50e-6, 1e-3, 0.01
"""Largest shift of a stamp and of a range, and share of beams without return, in a perturbed replay."""
LEG_M, NEAR, FAR = 0.2, np.array((0.6, -2.0)), np.array((3.0, 2.0))
"""Radius of a visitor, and the corners of where visitors walk, seen from the robot, m."""


def spoil(drive: Drive, log: str, kind: str, seed: int) -> Drive:
    """Spoil a drive, by its own random numbers."""
    KINDS[kind](drive, np.random.default_rng((zlib.crc32(f"{log} {kind}".encode()), seed)))
    return drive


def _somewhere(drive: Drive, rng: Rng, among: Array | None = None) -> int:
    """A scan from the middle half of the drive, where it begins."""
    count = len(drive.stamps)
    some = np.arange(count // 4, 3 * count // 4)
    drive.begun = int(rng.choice(some if among is None else some[among[some]]))
    return drive.begun


def _perturbed(drive: Drive, rng: Rng) -> None:
    """Nothing that a robot could notice: microseconds, millimetres, single beams."""
    drive.stamps = drive.stamps + rng.uniform(-STAMP_S, STAMP_S, len(drive.stamps))
    moved = drive.ranges + drive.returned * rng.uniform(-RANGE_M, RANGE_M, drive.ranges.shape)
    drive.ranges = np.where(rng.random(moved.shape) < DROPPED, drive.none, moved)


def _rate(hertz: float) -> Spoil:
    """A lidar that turns more slowly."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        every = max(1, round(1.0 / (hertz * float(np.median(np.diff(drive.stamps))))))
        drive.keep(np.arange(int(rng.integers(every)), len(drive.stamps), every))

    return spoiled


def _reading(x_m: float, yaw: float, count: int = 1) -> Spoil:
    """The odometry pose is wrong in a few readings, and right again in the next."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        at = _somewhere(drive, rng)
        off = rng.choice([-1.0, 1.0], 3) * (x_m, 0.0, yaw)
        drive.robot[at : at + count] += off
        drive.laser[at : at + count] += off

    return spoiled


def _poor_second(drive: Drive, rng: Rng) -> None:
    """Of a second's scans only the nearest eighth of the beams comes back."""
    at, returned = _somewhere(drive, rng), drive.returned
    for k in range(at, at + 12):
        seen = np.flatnonzero(returned[k])
        drive.ranges[k, seen[np.argsort(drive.ranges[k, seen])[drive.ranges.shape[1] // 8 :]]] = drive.none


def _gap(seconds: float) -> Spoil:
    """Nothing is received for a while."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        since = drive.stamps - drive.stamps[_somewhere(drive, rng)]
        drive.keep(np.flatnonzero((since < 0.0) | (since >= seconds)))

    return spoiled


def _visitors(count: int) -> Spoil:
    """People who walk along with the robot, some metres in front of it."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        at, speed = rng.uniform(NEAR, FAR, (count, 2)), rng.uniform((-0.3, -0.8), (0.3, 0.8), (count, 2))
        seen = np.where(drive.returned, drive.ranges, np.inf)
        for k, dt in enumerate(np.clip(np.diff(drive.stamps, prepend=drive.stamps[0]), 0.0, 1.0).tolist()):
            at = at + dt * speed
            speed = np.where((at < NEAR) & (speed < 0.0) | (at > FAR) & (speed > 0.0), -speed, speed)
            ahead = np.exp(-1j * drive.bearings)[None, :] * (at[:, :1] + 1j * at[:, 1:])
            half = np.sqrt(np.maximum(LEG_M**2 - ahead.imag**2, 0.0))
            leg = np.where((half > 0.0) & (ahead.real > 0.0), ahead.real - half, np.inf).min(axis=0)
            hit = leg < seen[k]
            drive.ranges[k, hit] = leg[hit] + rng.normal(0.0, 0.01, int(hit.sum()))

    return spoiled


def _glass(drive: Drive, rng: Rng) -> None:
    """Blocks of neighbouring beams, two fifths of all, have no return; they pass by as the robot drives."""
    beams, scans = np.linspace(0.0, 44.0, drive.ranges.shape[1]), np.arange(len(drive.stamps))[:, None]
    drive.ranges = np.where(np.sin(beams + 0.03 * scans + rng.uniform(0.0, math.tau)) > 0.3, drive.none, drive.ranges)


def _swapped(drive: Drive, rng: Rng) -> None:
    """Every tenth pair of scans arrives in the wrong order."""
    order = np.arange(len(drive.stamps))
    for k in range(int(rng.integers(10)), len(order) - 1, 10):
        order[k : k + 2] = order[k + 1], order[k]
    drive.keep(order)


def _clock(change: Callable[[Array, int], object]) -> Spoil:
    """Stamps (n,) are changed, from a scan on."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        drive.stamps = np.asarray(change(drive.stamps.copy(), _somewhere(drive, rng)))

    return spoiled


def _set(seconds: float) -> Spoil:
    return _clock(lambda t, at: np.where(np.arange(len(t)) < at, t, t + seconds))


def _restarted(drive: Drive, rng: Rng) -> None:
    """The odometry begins anew at zero."""
    steps, at = drive.steps(), _somewhere(drive, rng)
    drive.robot[at] = 0.0
    drive.ride(steps[at:], at)


def _wheels(change: Callable[[Array], Array], seconds: float = math.inf) -> Spoil:
    """Odometry measures other steps than the robot makes: ``change`` of the steps (k, 3) of that time, or of all."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        steps, at = drive.steps(), 0
        if math.isfinite(seconds):
            at = _somewhere(drive, rng, np.hypot(*np.diff(drive.robot[:, :2], axis=0, append=np.nan).T) > 0.01)
        until = max(int(np.searchsorted(drive.stamps, drive.stamps[at] + seconds)), at + 1)
        steps[at:until] = change(steps[at:until])
        drive.ride(steps)

    return spoiled


def _turned(degrees: float, in_drive: bool) -> Spoil:
    """The lidar's mount is turned, from the start or from a third of the drive on, by whole beams."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        drive.begun = len(drive.stamps) // 3 if in_drive else 0
        count, beams = beams_of(drive, degrees), drive.ranges.shape[1]
        drive.ranges[drive.begun :] = np.roll(drive.ranges[drive.begun :], -count, axis=1)
        if np.ptp(drive.bearings) < math.radians(355.0):
            outside = slice(beams - count, beams) if count > 0 else slice(0, -count)
            drive.ranges[drive.begun :, outside] = drive.none

    return spoiled


def beams_of(drive: Drive, degrees: float) -> int:
    """An angle in whole beams."""
    return round(math.radians(degrees) / float(drive.bearings[1] - drive.bearings[0]))


def _displaced(x_m: float, y_m: float) -> Spoil:
    """The lidar is mounted elsewhere than the log has it."""

    def spoiled(drive: Drive, rng: Rng) -> None:
        c, s = np.cos(drive.robot[:, 2]), np.sin(drive.robot[:, 2])
        drive.laser[:, :2] += np.column_stack([c * x_m - s * y_m, s * x_m + c * y_m])
        by = {"robot_frontlaser_offset": x_m, "robot_frontlaser_side_offset": y_m}
        for k, words in enumerate(line.split() for line in drive.other):
            if words[0] == "PARAM" and words[1] in by:
                drive.other[k] = " ".join([*words[:2], f"{float(words[2]) + by[words[1]]:.6f}", *words[3:]]) + "\n"

    return spoiled


SPOILED: Final[dict[str, Spoil]] = {
    "spike": _reading(2.0, 0.0),
    "glitch": _reading(0.0, 2.0),
    "two glitches": _reading(0.0, 0.9, 2),
    "poor second": _poor_second,
    "gap of 5 s": _gap(5.0),
    "gap of 10 s": _gap(10.0),
    "8 visitors": _visitors(8),
    "20 visitors": _visitors(20),
    "glass": _glass,
    "5 Hz": _rate(5.0),
    "3.3 Hz": _rate(3.3),
    "2 Hz": _rate(2.0),
    "1 Hz": _rate(1.0),
    "swapped": _swapped,
    "clock set back": _set(-3.0),
    "clock set on": _set(3.0),
    "stamps repeat": _clock(lambda t, at: np.where(np.arange(len(t)) % 7 == 6, np.roll(t, 1), t)),
    "stamps stand still": _clock(lambda t, at: np.where((np.arange(len(t)) // 12) == at // 12, t[at // 12 * 12], t)),
    "whole seconds": _clock(lambda t, at: np.floor(t)),
    "zero stamps": _clock(lambda t, at: 0.0 * t),
    "odometry restarts": _restarted,
}
"""Wheels are right in all of these, but for single readings."""
WHEELS: Final[dict[str, Spoil]] = {
    "way +20 %": _wheels(lambda steps: steps * (1.2, 1.2, 1.0)),
    "turn +20 %": _wheels(lambda steps: steps * (1.0, 1.0, 1.2)),
    "dead 5 s": _wheels(lambda steps: 0.0 * steps, 5.0),
    "spun 180 deg": _wheels(lambda steps: steps + np.array((0.0, 0.0, math.pi)) / len(steps), 2.0),
    "slipped 3 m": _wheels(lambda steps: steps + np.array((3.0, 0.0, 0.0)) / len(steps), 3.0),
}
MOUNTS: Final = {
    f"{degrees:+d} deg {when}": (degrees, when == "in the drive")
    for when in ("at the start", "in the drive")
    for degrees in (3, -5, 7, -10)
}
"""Yaw (deg) of the mount less the configured one, and whether it is turned in the drive."""
OFFSETS: Final = {"x +5 cm": (0.05, 0.0), "y +5 cm": (0.0, 0.05)}
KINDS: Final[dict[str, Spoil]] = (
    {"perturbed": _perturbed}
    | SPOILED
    | WHEELS
    | {name: _turned(*of) for name, of in MOUNTS.items()}
    | {name: _displaced(*of) for name, of in OFFSETS.items()}
)
