"""How wrong the pose may be: a protection level, as aviation calls it, at the risk :data:`RISK` a pose.

If the place itself is not in doubt (who publishes the level knows that), the error of ``T_map_base`` is above it with
no more than that probability. It is the largest of what three hypotheses allow (multiple hypothesis solution
separation, Blanch et al., NAVIGATION 2010; docs/integrity.md has the derivation):

* nothing is wrong: quantiles of the covariance, raised by what errors that hang together make of it;
* light is wrong since lately (a lamp moved, exchanged, reflected): how far the pose has since left the one that the
  laser alone would have, plus what that one may be wrong by;
* the laser is wrong (it slipped, the room looks alike): how far the pose is from the one that light alone has, plus
  what that one may be wrong by.

Where there is one witness only nothing can be separated, and the first bound is widened instead. Laser and light share
the wheels; a slip of theirs moves both predictions, and each witness corrects it by itself. Without wheels they share
the laser's way (`guide`): a laser that slides leads light along until lamps have corrected it, for which the level
believes its position less (`lights_trust.UNGUIDED`); and of the heading the laser is the only witness.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np

from estimator.fusion.light_inflation import BESIDE_M, doubted_covariance
from estimator.fusion.map_odom_filter import pose_at
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import Fix, Protection
from estimator.state import State

RISK: Final = 1e-4
"""Probability with which an error may be above its bound, a pose."""
FAULTY: Final = 1e-3
"""Probability that a witness is wrong without contradicting the other, a pose."""
ALIKE: Final = 1.5
"""By how many deviations more errors are off that hang together: bending of the map, walls that reflect light."""
ALONE: Final = 1.5
"""By how much a bound is wider that one witness gives which nobody watches."""
UNKNOWN_M = 0.03
UNKNOWN_RAD = 0.01
"""What no filter knows of: stamps, lever arms, the survey itself."""
STRAIN_M, STRAIN_RAD = 0.02, 0.004
"""Drift of a pose that the laser alone carries on, by the root of a metre: three times what tours have shown."""
STRAIN: Final = np.diag((STRAIN_M**2, STRAIN_M**2, STRAIN_RAD**2))
MOST_M: Final = 30.0
"""A bound above this says nothing."""

K_PLAIN: Final = ALIKE * math.sqrt(-2.0 * math.log(0.5 * RISK))
"""Quantile of a distance in the plane (Rayleigh), and more than Gauss's of a heading, without a fault."""
K_FAULT: Final = ALIKE * math.sqrt(-2.0 * math.log(0.25 * RISK / FAULTY))
"""The same with one of two witnesses wrong, each of which may take a quarter of the risk."""


def bound(state: State, P: Array) -> Protection | None:
    """Bound on the error of the pose after this step, ``P`` being its covariance; None: there is none."""
    tie = state.absolute
    laser = state.local is not None and (state.fused.t_mono - state.t_match < 1.0)
    lit = tie is not None and tie.placed and state.light is not None and state.light.result.fix is Fix.GOOD
    _watch(state, P)
    horizontal, yaw = spread(P, K_PLAIN if laser and lit else ALONE * K_PLAIN)
    if laser and lit:
        yaw *= 1.0 if on_wheels(state) else ALONE
        for other in (_without_light(state), _without_laser(state)):
            horizontal, yaw = max(horizontal, other[0]), max(yaw, other[1])
    horizontal, yaw = horizontal + UNKNOWN_M, min(yaw + UNKNOWN_RAD, math.pi)
    if not horizontal < MOST_M:
        return None
    return Protection(horizontal, yaw, laser, lit, state.fused.odometry)


def on_wheels(state: State) -> bool:
    """Whether light hears from wheels how the robot moves."""
    return state.light is not None and state.light.on_wheels


def _watch(state: State, P: Array) -> None:
    """Keep the tie that light is held against, as long as the laser carries the pose on from it."""
    tie = state.absolute
    if tie is None:
        return
    if not tie.placed or not tie.proved or tie.broken:
        state.frozen.forget()
    else:
        state.frozen.take(state.T_map_odom, P, state.way)


def _without_light(state: State) -> tuple[float, float]:
    """What the laser alone says, light not believed since the tie was frozen: separation and spread."""
    if not state.frozen.kept:
        return 0.0, 0.0
    T_map_odom, P, way = state.frozen.kept[0]
    T_odom_base = state.fused.T_odom_base
    off = se2.between(se2.compose(T_map_odom, T_odom_base), se2.compose(state.T_map_odom, T_odom_base))
    far, turned = spread(P + max(state.way - way, 0.0) * STRAIN, K_FAULT)
    return math.hypot(off[0], off[1]) + far, abs(float(off[2])) + turned


def _without_laser(state: State) -> tuple[float, float]:
    """What light alone says: separation and spread. Without wheels it says nothing of the heading."""
    tie, light = state.absolute, state.light
    assert tie is not None
    assert light is not None
    wheels = on_wheels(state)
    in_row = tie.row.narrow(BESIDE_M)
    said, (covered, _) = light.result, doubted_covariance(light.result, tie.way - tie.way_young, wheels, in_row)
    here = se2.compose(state.T_map_odom, pose_at(state, max(said.t_mono, said.t_pose)))
    off = said.T_map_base - here
    far, turned = spread(covered, K_FAULT)
    heading = 0.0 if not wheels else abs(se2.wrap(float(off[2]))) + turned
    return math.hypot(off[0], off[1]) + far, heading


def spread(P: Array, k: float) -> tuple[float, float]:
    """``k`` deviations of a covariance (3, 3): of the larger axis in the plane, and of the heading."""
    (xx, xy, _), (_, yy, _), (_, _, tt) = P.tolist()
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return k * math.sqrt(max(0.0, mean + half)), k * math.sqrt(max(0.0, tt))
