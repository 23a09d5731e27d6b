"""Protection level of the pose: upper limit of its error at the integrity risk :data:`RISK`, by solution separation.

If the pose is the right hypothesis, the error of ``T_map_base`` exceeds the level with no more than that probability.
The publisher checks that condition. The level is the largest under three fault hypotheses (multiple hypothesis solution
separation, Blanch et al., NAVIGATION 2010; docs/integrity.md has the derivation):

* No fault: quantiles of the covariance, enlarged for correlated errors.
* Light has been wrong recently (a lamp moved, exchanged, reflected): the separation of the pose from the lidar
  solution, plus the error of that solution.
* The lidar is wrong (it slipped, or the room looks alike): the separation of the pose from the light solution, plus the
  error of that solution.

With one sensor only there is no separation, and the first limit is enlarged instead. Lidar and light share the
odometry. Its slip moves both predictions, and each sensor corrects it by itself. Without odometry they share the
lidar's motion (`guide`). A lidar match that slides moves the light solution along until lamps have corrected it. The
level then uses a larger covariance of the light position (`light_inflation.UNGUIDED`). The heading then comes from the
lidar alone.
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
"""Integrity risk: probability per pose that the error exceeds the protection level."""
FAULTY: Final = 1e-3
"""Probability per pose that one sensor is wrong and agrees with the other."""
ALIKE: Final = 1.5
"""Enlargement of sigma for correlated errors: deformation of the map, walls that reflect light."""
ALONE: Final = 1.5
"""Enlargement of a limit that one sensor gives without another to check it."""
UNKNOWN_M = 0.03
UNKNOWN_RAD = 0.01
"""Errors outside every filter's model (m, rad): stamps, lever arms, the survey itself."""
STRAIN_M, STRAIN_RAD = 0.02, 0.004
"""Drift of a pose by the lidar alone, per root of a metre (m, rad): three times the drift measured on tours."""
STRAIN: Final = np.diag((STRAIN_M**2, STRAIN_M**2, STRAIN_RAD**2))
MOST_M: Final = 30.0
"""Largest useful protection level, m; above it the level is unavailable."""

K_PLAIN: Final = ALIKE * math.sqrt(-2.0 * math.log(0.5 * RISK))
"""Fault-free quantile of a distance in the plane (Rayleigh); it exceeds the Gaussian quantile of a heading."""
K_FAULT: Final = ALIKE * math.sqrt(-2.0 * math.log(0.25 * RISK / FAULTY))
"""The same with one of two sensors wrong; each may use a quarter of the risk."""


def bound(
    pose: MapPose,
    motion: Motion,
    light: LightChannel | None,
    matching: MatchMemory,
    P: Array,
    mount_rad: float = 0.0,
) -> Protection | None:
    """Protection level of the pose after this step; None if it is unavailable.

    ``P``: its covariance. ``mount_rad``: largest heading error by the lidar mount, rad.
    """
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
    horizontal, yaw = horizontal + UNKNOWN_M, min(yaw + UNKNOWN_RAD + mount_rad, math.pi)
    if not horizontal < MOST_M:
        return None
    return Protection(horizontal, yaw, laser, lit, motion.odometry)


def on_wheels(light: LightChannel | None) -> bool:
    """Whether odometry drives the light filter."""
    return light is not None and light.on_wheels


def _snapshot(pose: MapPose, steps: float, P: Array) -> None:
    """Keep T_map_odom for the lidar solution, as long as the lidar tracks the pose without a break."""
    alignment = pose.alignment
    if alignment is None:
        return
    if not alignment.placed or not alignment.proved or alignment.broken:
        pose.history.forget()
    else:
        pose.history.take(pose.T_map_odom, P, steps)


def _without_light(pose: MapPose, motion: Motion, steps: float) -> tuple[float, float]:
    """Lidar solution, without light since the oldest snapshot: separation plus its error (m, rad)."""
    if not pose.history.kept:
        return 0.0, 0.0
    T_map_odom, P, begun = pose.history.kept[0]
    T_odom_base = motion.T_odom_base
    off = se2.between(se2.compose(T_map_odom, T_odom_base), pose.here(T_odom_base))
    far, turned = spread(P + max(steps - begun, 0.0) * STRAIN, K_FAULT)
    return math.hypot(off[0], off[1]) + far, abs(float(off[2])) + turned


def _without_laser(pose: MapPose, motion: Motion, light: LightChannel) -> tuple[float, float]:
    """Light solution: separation plus its error (m, rad). Without odometry it gives no heading."""
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
    """``k`` sigmas of a covariance (3, 3): of the larger axis in the plane (m), and of the heading (rad)."""
    (xx, xy, _), (_, yy, _), (_, _, tt) = P.tolist()
    mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
    return k * math.sqrt(max(0.0, mean + half)), k * math.sqrt(max(0.0, tt))
