"""A room with known walls, a drive through it, and logs of that drive, made for the tests of replay."""

import math
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WALLS = np.array(
    [
        (0, 0, 9, 0),
        (9, 0, 9, 6.5),
        (9, 6.5, 0, 6.5),
        (0, 6.5, 0, 0),
        (3.2, 2.1, 4.0, 2.1),
        (4.0, 2.1, 4.0, 3.3),
        (4.0, 3.3, 3.2, 3.3),
        (3.2, 3.3, 3.2, 2.1),
        (9, 4.5, 7.4, 4.5),
        (6.0, 0, 6.0, 0.9),
    ],
    dtype=np.float64,
)
"""Segments x1 y1 x2 y2, metres."""

PERIOD_S = 0.1


@dataclass(frozen=True)
class Drive:
    """True poses (n, 3), wheel odometry (n, 3), ranges (n, beams) in metres, stamps (n,)."""

    truth: Array
    odometry: Array
    ranges: Array
    stamps: Array


def cast(x: float, y: float, bearings: Array) -> Array:
    """Distance to the nearest wall along each direction."""
    x1, y1, x2, y2 = WALLS.T[:, :, None]
    dx, dy = np.cos(bearings)[None], np.sin(bearings)[None]
    ex, ey = x2 - x1, y2 - y1
    with np.errstate(divide="ignore", invalid="ignore"):
        cross = dx * ey - dy * ex
        along = ((x1 - x) * ey - (y1 - y) * ex) / cross
        part = ((x1 - x) * dy - (y1 - y) * dx) / cross
    return np.asarray(np.where((along > 0) & (part >= 0) & (part <= 1), along, np.inf).min(axis=0))


def drive(scans: int = 120, beams: int = 181, seed: int = 1) -> Drive:
    """A loop around the block in the middle; wheels that slip by a few per cent."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0.0, 2 * math.pi * scans / 240, scans)
    truth = np.stack([3.6 + 2.4 * np.cos(phase), 2.9 + 1.9 * np.sin(phase), np.zeros(scans)], axis=1)
    truth[:, 2] = np.arctan2(1.9 * np.cos(phase), -2.4 * np.sin(phase))
    fan = np.radians(np.linspace(-90, 90, beams))
    ranges = np.array([cast(x, y, fan + yaw) for x, y, yaw in truth.tolist()])
    ranges += rng.normal(0.0, 0.008, ranges.shape)
    return Drive(truth, _odometry(truth, rng), ranges, 1000.0 + PERIOD_S * np.arange(scans))


def _odometry(truth: Array, rng: np.random.Generator) -> Array:
    pose, poses = np.array(truth[0]), [np.array(truth[0])]
    for before, after in pairwise(truth):
        c, s = math.cos(before[2]), math.sin(before[2])
        dx, dy = after[0] - before[0], after[1] - before[1]
        turn = math.remainder(after[2] - before[2], 2 * math.pi) * rng.normal(1.03, 0.02)
        way = (c * dx + s * dy) * rng.normal(0.97, 0.02)
        side = c * dy - s * dx
        x, y = (
            math.cos(pose[2]) * way - math.sin(pose[2]) * side,
            math.sin(pose[2]) * way + math.cos(pose[2]) * side,
        )
        pose = pose + np.array((x, y, turn))
        poses.append(pose)
    return np.array(poses)


def carmen(path: Path, run: Drive) -> Path:
    """The drive as a log with FLASER lines."""
    lines = []
    for ranges, odometry, stamp in zip(run.ranges, run.odometry, run.stamps, strict=True):
        values = " ".join(f"{value:.2f}" for value in ranges.tolist())
        pose = " ".join(f"{value:.6f}" for value in odometry.tolist())
        lines.append(f"FLASER {len(ranges)} {values} {pose} {pose} {stamp:.6f} host {stamp:.6f}")
    path.write_text("\n".join(lines) + "\n")
    return path


def read_tum(path: Path) -> tuple[Array, Array]:
    """Stamps and (x, y, yaw)."""
    rows = np.loadtxt(path, comments="#", ndmin=2)
    assert rows.shape[1] == 8
    assert np.allclose(np.hypot(rows[:, 6], rows[:, 7]), 1.0, atol=1e-8)
    return rows[:, 0], np.column_stack([rows[:, 1], rows[:, 2], 2 * np.arctan2(rows[:, 6], rows[:, 7])])


def relative(poses: Array, start: Array) -> Array:
    """Poses seen from ``start``."""
    c, s = math.cos(start[2]), math.sin(start[2])
    dx, dy = poses[:, 0] - start[0], poses[:, 1] - start[1]
    return np.column_stack(
        [c * dx + s * dy, c * dy - s * dx, np.remainder(poses[:, 2] - start[2] + np.pi, 2 * np.pi) - np.pi]
    )
