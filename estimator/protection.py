"""How wrong the pose may be: a protection level, as aviation calls it, at the risk :data:`RISK` a pose.

If the place itself is not in doubt (who reads the result has to know that), the error of ``T_map_base`` is above the
level with no more than that probability. The largest of these holds:

* nothing is wrong: the covariance, raised by what errors that hang together make of it (:data:`ALIKE`), at its part of
  the risk, and what neither filter knows of;
* light is wrong, or the laser is: what the other witness says of the place (:mod:`docs/integrity.md`).
"""

from __future__ import annotations

import math
from typing import Final

from estimator.fusion import covariance
from estimator.records import Array
from estimator.result import Protection
from estimator.state import State

RISK: Final = 1e-4
"""Probability with which an error may be above its bound, a pose."""
ALIKE: Final = 2.0
"""By how many deviations more errors may be off that hang together: bending of the map, walls that reflect light."""
UNKNOWN_M, UNKNOWN_RAD = 0.03, 0.005
"""What no filter knows of: stamps, lever arms, the survey itself."""
MOST_M: Final = 30.0
"""A bound above this says nothing."""


def bound(state: State) -> Protection | None:
    """Bound on the error of the pose after this step; None: there is none."""
    P = covariance(state)
    tie = state.absolute
    horizontal, yaw = _faultless(P)
    if not horizontal < MOST_M:
        return None
    light = tie is not None and tie.placed and tie.gap is not None
    laser = state.fused.t_mono - state.t_match < 1.0
    return Protection(horizontal, min(yaw, math.pi), laser, light, state.fused.odometry)


def _faultless(P: Array) -> tuple[float, float]:
    """The bound where nothing is wrong: Rayleigh's quantile in the plane, Gauss's in heading."""
    mean, half = 0.5 * (P[0, 0] + P[1, 1]), math.hypot(0.5 * (P[0, 0] - P[1, 1]), P[0, 1])
    k = ALIKE * math.sqrt(-2.0 * math.log(0.5 * RISK))
    return UNKNOWN_M + k * math.sqrt(max(0.0, mean + half)), UNKNOWN_RAD + k * math.sqrt(max(0.0, float(P[2, 2])))
