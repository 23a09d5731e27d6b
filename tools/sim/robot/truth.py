"""True poses of the robot: interpolated in time, and as seen from the map of a daemon."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from tools.sim.robot.drive import Array

Pose = tuple[float, float, float]
"""x, y in m, yaw in rad."""


def in_map(truth: npt.ArrayLike, at: npt.ArrayLike, pose: npt.ArrayLike) -> Array:
    """True poses (..., 3) as seen from the map in which the robot, truly ``at``, has ``pose`` (3,)."""
    true, (x0, y0, yaw0), (x, y, yaw) = np.asarray(truth, dtype=np.float64), np.asarray(at), np.asarray(pose)
    turn = yaw - yaw0
    c, s = math.cos(turn), math.sin(turn)
    dx, dy = true[..., 0] - x0, true[..., 1] - y0
    return np.stack([x + c * dx - s * dy, y + s * dx + c * dy, true[..., 2] + turn], axis=-1)


def at_time(track: Sequence[tuple[float, Pose]], t: float) -> Pose | None:
    """The true pose at ``t`` (s), interpolated between stamped poses in order; None where they do not cover it."""
    after = bisect_left(track, t, key=lambda one: one[0])
    if after == 0 or after == len(track):
        return None
    (t0, a), (t1, b) = track[after - 1], track[after]
    part = (t - t0) / (t1 - t0)
    turn = math.remainder(b[2] - a[2], math.tau)
    return a[0] + part * (b[0] - a[0]), a[1] + part * (b[1] - a[1]), a[2] + part * turn
