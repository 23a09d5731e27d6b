"""The angle between the two longest walls that are not parallel, in single scans and in a map."""

from typing import Final

import numpy as np

from tools.experiments.belief.logs import Drive
from tools.sim.building.world import Array

NEAR_M, GAP_M = 0.06, 0.5
"""Points this near to a line are on it: half of a mapped wall. A wall ends where it has a wider gap."""
APART_RAD, TURNED_RAD = 0.8, 0.15
"""Two walls are no parallels from this angle on; a line that turns by more as it is fitted is another one."""
LEAST_M, LEAST_POINTS = 1.5, 12
"""A wall is at least this long and has so many points."""
STEADY: Final = 0.3
"""Largest yaw rate (rad/s) of a scan that counts: a scan that takes 0.1 s is not bent by more than two degrees."""


def of_scans(drive: Drive) -> tuple[float, int]:
    """Median angle (deg) over the scans that show two walls, and how many do."""
    rate = np.abs(np.gradient(np.unwrap(drive.robot[:, 2]))) / np.gradient(drive.stamps)
    found = []
    for k in np.flatnonzero(rate < STEADY).tolist():
        seen = drive.returned[k]
        r, b = drive.ranges[k, seen], drive.bearings[seen]
        found.append(between(np.column_stack([r * np.cos(b), r * np.sin(b)])))
    angles = np.array(found)[np.isfinite(found)]
    return (float(np.median(angles)) if len(angles) else np.nan), len(angles)


def between(points: Array) -> float:
    """Angle (deg, 0 to 180) of the second longest wall of points (n, 2) against the longest; NaN without two."""
    first = longest(points)
    second = None if first is None else longest(points, first[0])
    return np.nan if first is None or second is None else float(np.degrees((second[0] - first[0]) % np.pi))


def longest(points: Array, not_along: float | None = None) -> tuple[float, float] | None:
    """Direction (rad) and length (m) of the longest wall, of those that are well turned against a direction."""
    if len(points) < LEAST_POINTS:
        return None
    angles = np.radians(np.arange(0.0, 180.0, 0.5))
    if not_along is not None:
        angles = angles[np.abs(np.sin(angles - not_along)) > np.sin(APART_RAD)]
    line = np.rint(points @ np.array((-np.sin(angles), np.cos(angles))) / NEAR_M).astype(int)
    line -= line.min()
    votes = np.zeros((len(angles), int(line.max()) + 1), int)
    np.add.at(votes, (np.arange(len(angles))[None, :], line), 1)
    found = []
    for flat in np.argsort(votes, axis=None)[-12:].tolist():  # the longest need not be the one with most points
        k, number = divmod(flat, votes.shape[1])
        wall = fitted(points, float(angles[k]), points[line[:, k] == number].mean(axis=0))
        if wall is not None and wall[1] >= LEAST_M and abs(np.sin(wall[0] - angles[k])) < TURNED_RAD:
            found.append(wall)
    return max(found, key=lambda wall: wall[1], default=None)


def fitted(points: Array, angle: float, centre: Array) -> tuple[float, float] | None:
    """Total least squares of the longest unbroken stretch of points on a line through a centre."""
    for _ in range(3):
        off = points - centre
        near = points[np.abs(off[:, 1] * np.cos(angle) - off[:, 0] * np.sin(angle)) < NEAR_M]
        s = (near - centre) @ np.array((np.cos(angle), np.sin(angle)))
        order = np.argsort(s)
        part = max(np.split(order, np.flatnonzero(np.diff(s[order]) > GAP_M) + 1), key=len)
        if len(part) < LEAST_POINTS:
            return None
        centre = near[part].mean(axis=0)
        along = np.linalg.svd(near[part] - centre, full_matrices=False)[2][0]
        angle = float(np.arctan2(along[1], along[0])) % np.pi
    return angle, float(np.ptp(s[part]))
