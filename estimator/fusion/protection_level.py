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
believes its position less (`light_inflation.UNGUIDED`); and of the heading the laser is the only witness.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from estimator.fusion.light_inflation import BESIDE_M, doubted_covariance
from estimator.fusion.light_witness import pose_at
from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import Fix, Protection
from estimator.scan_matching.match_memory import MatchMemory

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel

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


def bound(
    pose: MapPose, motion: Motion, light: LightChannel | None, matching: MatchMemory, P: Array
) -> Protection | None:
    """Bound on the error of the pose after this step, ``P`` being its covariance; None: there is none."""
    alignment = pose.alignment
    laser = matching.local_map is not None and (motion.t_mono - matching.t_match < 1.0)
    lit = alignment is not None and alignment.placed and light is not None and light.result.fix is Fix.GOOD
    _snapshot(pose, matching.steps, P)
    horizontal, yaw = spread(P, K_PLAIN if laser and lit else ALONE * K_PLAIN)
    if laser and lit:
        yaw *= 1.0 if on_wheels(light) else ALONE
        assert light is not None
        for other in (_without_light(pose, motion, matching.steps), _without_laser(pose, motion, light)):
            horizontal, yaw = max(horizontal, other[0]), max(yaw, other[1])
    horizontal, yaw = horizontal + UNKNOWN_M, min(yaw + UNKNOWN_RAD, math.pi)
    if not horizontal < MOST_M:
        return None
    return Protection(horizontal, yaw, laser, lit, motion.odometry)


def on_wheels(light: LightChannel | None) -> bool:
    """Whether wheels move the light filter."""
    return light is not None and light.on_wheels


def _snapshot(pose: MapPose, steps: float, P: Array) -> None:
    """Keep T_map_odom for light to be compared with, as long as the laser carries the pose on from it."""
    alignment = pose.alignment
    if alignment is None:
        return
    if not alignment.placed or not alignment.proved or alignment.broken:
        pose.history.forget()
    else:
        pose.history.take(pose.T_map_odom, P, steps)


def _without_light(pose: MapPose, motion: Motion, steps: float) -> tuple[float, float]:
    """The solution of the laser alone, without light since the oldest snapshot: separation and spread (m, rad)."""
    if not pose.history.kept:
        return 0.0, 0.0
    T_map_odom, P, begun = pose.history.kept[0]
    T_odom_base = motion.T_odom_base
    off = se2.between(se2.compose(T_map_odom, T_odom_base), pose.here(T_odom_base))
    far, turned = spread(P + max(steps - begun, 0.0) * STRAIN, K_FAULT)
    return math.hypot(off[0], off[1]) + far, abs(float(off[2])) + turned


def _without_laser(pose: MapPose, motion: Motion, light: LightChannel) -> tuple[float, float]:
    """What light alone says: separation and spread. Without wheels it says nothing of the heading."""
    alignment = pose.alignment
    assert alignment is not None
    wheels = light.on_wheels
    in_row = alignment.row.narrow(BESIDE_M)
    said, young_m = light.result, alignment.way - alignment.way_young
    covered, _ = doubted_covariance(said, young_m, wheels, in_row)
    here = pose.here(pose_at(pose, motion, max(said.t_mono, said.t_pose)))
    off = said.T_map_base - here
    far, turned = spread(covered, K_FAULT)
    heading = 0.0 if not wheels else abs(se2.wrap(float(off[2]))) + turned
    return math.hypot(off[0], off[1]) + far, heading


def spread(P: Array, k: float) -> tuple[float, float]:
    """``k`` deviations of a covariance (3, 3): of the larger axis in the plane, and of the heading."""
    (xx, xy, _), (_, yy, _), (_, _, tt) = P.tolist()
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return k * math.sqrt(max(0.0, mean + half)), k * math.sqrt(max(0.0, tt))
