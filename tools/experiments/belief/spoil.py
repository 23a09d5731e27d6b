"""Real drives spoiled as robots in the field spoil theirs: each kind by itself, at random from a seed."""

import math
import zlib
from collections.abc import Callable
from functools import partial
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


def _rate(drive: Drive, rng: Rng, hertz: float) -> None:
    """A lidar that turns more slowly."""
    every = max(1, round(1.0 / (hertz * float(np.median(np.diff(drive.stamps))))))
    drive.keep(np.arange(int(rng.integers(every)), len(drive.stamps), every))


def _reading(drive: Drive, rng: Rng, x_m: float, yaw: float, count: int = 1) -> None:
    """The odometry pose is wrong in a few readings, and right again in the next."""
    at = _somewhere(drive, rng)
    off = rng.choice([-1.0, 1.0], 3) * (x_m, 0.0, yaw)
    drive.robot[at : at + count] += off
    drive.laser[at : at + count] += off


def _poor_second(drive: Drive, rng: Rng) -> None:
    """Of a second's scans only the nearest eighth of the beams comes back."""
    at, returned = _somewhere(drive, rng), drive.returned
    for k in range(at, at + 12):
        seen = np.flatnonzero(returned[k])
        drive.ranges[k, seen[np.argsort(drive.ranges[k, seen])[drive.ranges.shape[1] // 8 :]]] = drive.none


def _gap(drive: Drive, rng: Rng, seconds: float) -> None:
    """Nothing is received for a while."""
    since = drive.stamps - drive.stamps[_somewhere(drive, rng)]
    drive.keep(np.flatnonzero((since < 0.0) | (since >= seconds)))


def _visitors(drive: Drive, rng: Rng, count: int) -> None:
    """People who walk along with the robot, some metres in front of it."""
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


def _clock(drive: Drive, rng: Rng, change: Callable[[Array, int], object]) -> None:
    """Stamps (n,) are changed, from a scan on."""
    drive.stamps = np.asarray(change(drive.stamps.copy(), _somewhere(drive, rng)))


def _restarted(drive: Drive, rng: Rng) -> None:
    """The odometry begins anew at zero."""
    steps, at = drive.steps(), _somewhere(drive, rng)
    drive.robot[at] = 0.0
    drive.ride(steps[at:], at)


def _wheels(drive: Drive, rng: Rng, change: Callable[[Array], Array], seconds: float = math.inf) -> None:
    """Odometry measures other steps than the robot makes: ``change`` of the steps (k, 3) of that time, or of all."""
    steps, at = drive.steps(), 0
    if math.isfinite(seconds):
        at = _somewhere(drive, rng, np.hypot(*np.diff(drive.robot[:, :2], axis=0, append=np.nan).T) > 0.01)
    until = max(int(np.searchsorted(drive.stamps, drive.stamps[at] + seconds)), at + 1)
    steps[at:until] = change(steps[at:until])
    drive.ride(steps)


def _turned(drive: Drive, rng: Rng, degrees: float, in_drive: bool) -> None:
    """The lidar's mount is turned, from the start or from a third of the drive on, by whole beams."""
    drive.begun = len(drive.stamps) // 3 if in_drive else 0
    count, beams = beams_of(drive, degrees), drive.ranges.shape[1]
    drive.ranges[drive.begun :] = np.roll(drive.ranges[drive.begun :], -count, axis=1)
    if np.ptp(drive.bearings) < math.radians(355.0):
        outside = slice(beams - count, beams) if count > 0 else slice(0, -count)
        drive.ranges[drive.begun :, outside] = drive.none


def beams_of(drive: Drive, degrees: float) -> int:
    """An angle in whole beams."""
    return round(math.radians(degrees) / float(drive.bearings[1] - drive.bearings[0]))


def _displaced(drive: Drive, rng: Rng, x_m: float, y_m: float) -> None:
    """The lidar is mounted elsewhere than the log has it."""
    c, s = np.cos(drive.robot[:, 2]), np.sin(drive.robot[:, 2])
    drive.laser[:, :2] += np.column_stack([c * x_m - s * y_m, s * x_m + c * y_m])
    by = {"robot_frontlaser_offset": x_m, "robot_frontlaser_side_offset": y_m}
    for k, words in enumerate(line.split() for line in drive.other):
        if words[0] == "PARAM" and words[1] in by:
            drive.other[k] = " ".join([*words[:2], f"{float(words[2]) + by[words[1]]:.6f}", *words[3:]]) + "\n"


SPOILED: Final[dict[str, Spoil]] = {
    "spike": partial(_reading, x_m=2.0, yaw=0.0),
    "glitch": partial(_reading, x_m=0.0, yaw=2.0),
    "two glitches": partial(_reading, x_m=0.0, yaw=0.9, count=2),
    "poor second": _poor_second,
    "gap of 5 s": partial(_gap, seconds=5.0),
    "gap of 10 s": partial(_gap, seconds=10.0),
    "8 visitors": partial(_visitors, count=8),
    "20 visitors": partial(_visitors, count=20),
    "glass": _glass,
    "5 Hz": partial(_rate, hertz=5.0),
    "3.3 Hz": partial(_rate, hertz=3.3),
    "2 Hz": partial(_rate, hertz=2.0),
    "1 Hz": partial(_rate, hertz=1.0),
    "swapped": _swapped,
    "clock set back": partial(_clock, change=lambda t, at: t - 3.0 * (np.arange(len(t)) >= at)),
    "clock set on": partial(_clock, change=lambda t, at: t + 3.0 * (np.arange(len(t)) >= at)),
    "stamps repeat": partial(_clock, change=lambda t, at: np.where(np.arange(len(t)) % 7 == 6, np.roll(t, 1), t)),
    "stamps stand still": partial(
        _clock, change=lambda t, at: np.where(np.arange(len(t)) // 12 == at // 12, t[at // 12 * 12], t)
    ),
    "whole seconds": partial(_clock, change=lambda t, at: np.floor(t)),
    "zero stamps": partial(_clock, change=lambda t, at: 0.0 * t),
    "odometry restarts": _restarted,
}
"""Wheels are right in all of these, but for single readings."""
WHEELS: Final[dict[str, Spoil]] = {
    "way +20 %": partial(_wheels, change=lambda steps: steps * (1.2, 1.2, 1.0)),
    "turn +20 %": partial(_wheels, change=lambda steps: steps * (1.0, 1.0, 1.2)),
    "dead 5 s": partial(_wheels, change=lambda steps: 0.0 * steps, seconds=5.0),
    "spun 180 deg": partial(
        _wheels, change=lambda steps: steps + np.array((0.0, 0.0, math.pi)) / len(steps), seconds=2.0
    ),
    "slipped 3 m": partial(_wheels, change=lambda steps: steps + np.array((3.0, 0.0, 0.0)) / len(steps), seconds=3.0),
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
    | {name: partial(_turned, degrees=of[0], in_drive=of[1]) for name, of in MOUNTS.items()}
    | {name: partial(_displaced, x_m=of[0], y_m=of[1]) for name, of in OFFSETS.items()}
)
