"""Real drives spoiled as robots in the field spoil theirs: by chance from a seed, and each kind by itself."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable
from typing import Final

import numpy as np

from tools.experiments.belief.logs import Drive
from tools.sim.building.world import Array

Spoil = Callable[[Drive, np.random.Generator], None]

STAMP_S, RANGE_M, DROPPED = 50e-6, 1e-3, 0.01
"""Largest shift of a stamp and of a range, and share of beams without return, in a perturbed replay."""
LEG_M, NEAR_M, FAR_M = 0.2, 0.6, 3.0
"""Radius of a visitor, and the distances from the robot between which visitors walk."""


def rng_of(log: str, kind: str, seed: int) -> np.random.Generator:
    """The random numbers of one spoiled drive."""
    return np.random.default_rng((zlib.crc32(f"{log} {kind}".encode()), seed))


def perturbed(drive: Drive, rng: np.random.Generator) -> None:
    """Nothing that a robot could notice: microseconds, millimetres, single beams."""
    drive.stamps = drive.stamps + rng.uniform(-STAMP_S, STAMP_S, len(drive.stamps))
    seen, none = drive.returned, drive.none
    moved = np.where(seen, drive.ranges + rng.uniform(-RANGE_M, RANGE_M, drive.ranges.shape), drive.ranges)
    drive.ranges = np.where(rng.random(moved.shape) < DROPPED, none, moved)


def middle(drive: Drive, rng: np.random.Generator) -> int:
    """Where something happens: a scan from the middle half of the drive."""
    drive.begun = int(rng.integers(len(drive.stamps) // 4, 3 * len(drive.stamps) // 4))
    return drive.begun


def rate(hertz: float) -> Spoil:
    """A lidar that turns more slowly."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        every = max(1, round(1.0 / (hertz * float(np.median(np.diff(drive.stamps))))))
        drive.keep(np.arange(int(rng.integers(0, every)), len(drive.stamps), every))

    return spoil


def reading(x_m: float, yaw: float, count: int = 1) -> Spoil:
    """The odometry pose is wrong in one reading, or a few, and right again in the next."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        at = middle(drive, rng)
        off = (rng.choice([-1.0, 1.0]) * x_m, 0.0, rng.choice([-1.0, 1.0]) * yaw)
        drive.robot[at : at + count] += off
        drive.laser[at : at + count] += off

    return spoil


def poor_second(drive: Drive, rng: np.random.Generator) -> None:
    """Of a second's scans only the nearest eighth of the beams comes back."""
    at, none = middle(drive, rng), drive.none
    for k in range(at, min(at + 12, len(drive.stamps))):
        seen = np.flatnonzero(drive.returned[k])
        near = seen[np.argsort(drive.ranges[k, seen])[: drive.ranges.shape[1] // 8]]
        drive.ranges[k, np.setdiff1d(seen, near)] = none


def gap(seconds: float) -> Spoil:
    """Nothing is received for a while; the odometry goes on."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        t0 = drive.stamps[middle(drive, rng)]
        drive.keep(np.flatnonzero((drive.stamps < t0) | (drive.stamps >= t0 + seconds)))

    return spoil


def visitors(count: int) -> Spoil:
    """People who walk along with the robot, some metres in front of it."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        at = np.column_stack([rng.uniform(NEAR_M, FAR_M, count), rng.uniform(-2.0, 2.0, count)])
        speed = np.column_stack([rng.uniform(-0.3, 0.3, count), rng.uniform(-0.8, 0.8, count)])
        low, high, seen = np.array((NEAR_M, -2.0)), np.array((FAR_M, 2.0)), drive.returned
        for k, dt in enumerate(np.clip(np.diff(drive.stamps, prepend=drive.stamps[0]), 0.0, 1.0).tolist()):
            at = at + dt * speed
            speed = np.where((at < low) & (speed < 0.0) | (at > high) & (speed > 0.0), -speed, speed)
            for x, y in at.tolist():
                away, aside = math.hypot(x, y), drive.bearings - math.atan2(y, x)
                across = away * np.sin(aside)
                hit = (np.abs(across) < LEG_M) & (np.cos(aside) > 0.0)
                leg = away * np.cos(aside[hit]) - np.sqrt(LEG_M**2 - across[hit] ** 2) + rng.normal(0.0, 0.01)
                before = np.where(seen[k, hit], drive.ranges[k, hit], np.inf)
                drive.ranges[k, hit] = np.minimum(before, leg)

    return spoil


def glass(drive: Drive, rng: np.random.Generator) -> None:
    """Blocks of neighbouring beams, two fifths of all, have no return; they pass by as the robot drives."""
    beams, scans = np.arange(drive.ranges.shape[1]), np.arange(len(drive.stamps))[:, None]
    wave = np.sin(44.0 / len(beams) * beams + 0.03 * scans + rng.uniform(0.0, math.tau))
    drive.ranges = np.where(wave > 0.3, drive.none, drive.ranges)


def swapped(drive: Drive, rng: np.random.Generator) -> None:
    """Every tenth pair of scans arrives in the wrong order."""
    order = np.arange(len(drive.stamps))
    for k in range(int(rng.integers(0, 10)), len(order) - 1, 10):
        order[k : k + 2] = order[k + 1], order[k]
    drive.keep(order)


def set_clock(seconds: float) -> Spoil:
    """The clock is set, once."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        drive.stamps[middle(drive, rng) :] += seconds

    return spoil


def repeated(drive: Drive, rng: np.random.Generator) -> None:
    """Every seventh scan has the stamp of the one before."""
    drive.stamps[7::7] = drive.stamps[6:-1:7][: len(drive.stamps[7::7])]


def standing(drive: Drive, rng: np.random.Generator) -> None:
    """The clock stands still for a dozen scans."""
    at = middle(drive, rng)
    drive.stamps[at : at + 12] = drive.stamps[at]


def seconds_only(drive: Drive, rng: np.random.Generator) -> None:
    """Stamps are whole seconds."""
    drive.stamps = np.floor(drive.stamps)


def no_stamps(drive: Drive, rng: np.random.Generator) -> None:
    """All stamps are zero."""
    drive.stamps = 0.0 * drive.stamps


def restarted(drive: Drive, rng: np.random.Generator) -> None:
    """The odometry begins anew at zero."""
    steps, at = drive.steps(), middle(drive, rng)
    whole = drive.robot.copy()
    drive.robot = np.concatenate([drive.robot[:at], np.zeros((len(whole) - at, 3))])
    part = Drive(drive.setup, [], drive.stamps[at:], drive.ranges[at:], drive.laser[at:], drive.robot[at:], drive.index)
    part.laser = np.array([drive.laser[0] - whole[0]] * len(part.robot))
    part.ride(steps[at:])
    drive.robot[at:], drive.laser[at:] = part.robot, part.laser


def wheels(change: Callable[[Array, int, int], None], seconds: float = math.inf) -> Spoil:
    """Odometry measures other steps than the robot makes, from somewhere in the drive on, for ``seconds``."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        steps, at = drive.steps(), 0
        if math.isfinite(seconds):
            moving = np.flatnonzero(np.hypot(*steps[:, :2].T) > 0.01)
            at = drive.begun = int(rng.choice(moving[(moving > len(steps) // 4) & (moving < 3 * len(steps) // 4)]))
        until = int(np.searchsorted(drive.stamps, drive.stamps[at] + seconds))
        change(steps, at, max(until, at + 1))
        drive.ride(steps)

    return spoil


def scaled(way: float = 1.0, turn: float = 1.0) -> Callable[[Array, int, int], None]:
    """Path length and turn are measured too long."""

    def change(steps: Array, at: int, until: int) -> None:
        steps[at:until] *= (way, way, turn)

    return change


def added(way_m: float = 0.0, turn_rad: float = 0.0) -> Callable[[Array, int, int], None]:
    """Path length or turn that the robot does not make, spread over the time."""

    def change(steps: Array, at: int, until: int) -> None:
        steps[at:until] += np.array((way_m, 0.0, turn_rad)) / (until - at)

    return change


def turned(degrees: float, in_drive: bool) -> Spoil:
    """The lidar's mount is turned, from the start or from the first third on, by whole beams."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        drive.begun = len(drive.stamps) // 3 if in_drive else 0
        count = round(math.radians(degrees) / float(drive.bearings[1] - drive.bearings[0]))
        moved = np.roll(drive.ranges[drive.begun :], -count, axis=1)
        if np.ptp(drive.bearings) < math.radians(355.0):
            moved[:, -count if count > 0 else 0 : None if count > 0 else -count] = drive.none
        drive.ranges[drive.begun :] = moved

    return spoil


def displaced(x_m: float, y_m: float) -> Spoil:
    """The lidar is mounted elsewhere than the log has it."""

    def spoil(drive: Drive, rng: np.random.Generator) -> None:
        c, s = np.cos(drive.robot[:, 2]), np.sin(drive.robot[:, 2])
        drive.laser[:, :2] += np.column_stack([c * x_m - s * y_m, s * x_m + c * y_m])
        by = {"robot_frontlaser_offset": x_m, "robot_frontlaser_side_offset": y_m}
        for k, words in enumerate(line.split() for line in drive.other):
            if words[0] == "PARAM" and words[1] in by:
                drive.other[k] = " ".join([*words[:2], f"{float(words[2]) + by[words[1]]:.6f}", *words[3:]]) + "\n"

    return spoil


SPOILED: Final[dict[str, Spoil]] = {
    "spike": reading(2.0, 0.0),
    "glitch": reading(0.0, 1.0),
    "two glitches": reading(0.5, 0.9, 2),
    "poor second": poor_second,
    "gap 5 s": gap(5.0),
    "gap 10 s": gap(10.0),
    "8 visitors": visitors(8),
    "20 visitors": visitors(20),
    "glass": glass,
    "5 Hz": rate(5.0),
    "3.3 Hz": rate(3.3),
    "2 Hz": rate(2.0),
    "1 Hz": rate(1.0),
    "swapped": swapped,
    "clock back 3 s": set_clock(-3.0),
    "clock on 3 s": set_clock(3.0),
    "stamps repeat": repeated,
    "stamps stand still": standing,
    "whole seconds": seconds_only,
    "zero stamps": no_stamps,
    "odometry restarts": restarted,
}
"""Wheels are right in all of these, but for single readings."""
WHEELS: Final[dict[str, Spoil]] = {
    "way +20 %": wheels(scaled(way=1.2)),
    "turn +20 %": wheels(scaled(turn=1.2)),
    "dead 5 s": wheels(scaled(0.0, 0.0), 5.0),
    "spun 180 deg": wheels(added(turn_rad=math.pi), 2.0),
    "slipped 3 m": wheels(added(way_m=3.0), 3.0),
}
MOUNTS: Final = {
    f"{sign * degrees:+d} deg {when}": (sign * degrees, when == "in the drive")
    for when in ("at the start", "in the drive")
    for degrees, sign in ((3, 1), (5, -1), (7, 1), (10, -1))
}
"""Yaw (deg) by which the mount differs from the configured one, and whether it is turned in the drive."""
OFFSETS: Final = {"x +5 cm": (0.05, 0.0), "y +5 cm": (0.0, 0.05)}
KINDS: Final[dict[str, Spoil]] = (
    {"perturbed": perturbed}
    | SPOILED
    | WHEELS
    | {name: turned(*of) for name, of in MOUNTS.items()}
    | {name: displaced(*of) for name, of in OFFSETS.items()}
)
