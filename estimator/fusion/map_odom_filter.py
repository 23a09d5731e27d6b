"""Schmidt-Kalman filter of T_map_odom: light corrects the alignment with the survey and leaves T_odom_base unchanged.

The state is the error of ``T_map_base`` with its covariance ``P``. ``X`` is its covariance with the error of
``T_odom_base`` against the local map, whose own covariance is ``Motion.P``. Both errors grow by the same motion, so a
scan that corrects one corrects the other according to ``X``. What light has already corrected is not corrected twice. A
gain of zero for ``T_odom_base`` keeps it smooth and independent of light. So in a corridor the long axis comes from
light. In a room the lidar tracks the pose, and light aligns the map.

The light filter uses the same odometry. Therefore only the information that its links have *added* enters
(`LightsResult.gained`, a channel filter). Each segment of path or time with the same model error contributes the
information of one filter at most. Otherwise a robot at rest would average one wall reflection until its covariance
vanished.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from estimator.fusion.light_inflation import (
    BESIDE_M,
    across_the_row,
    doubted,
    without_heading,
)
from estimator.fusion.light_witness import KNOWN, SLOWEST_S, blind, holds_heading, pose_at, restarting
from estimator.fusion.map_pose import MapPose, SurveyAlignment
from estimator.fusion.motion_history import KEPT_S
from estimator.fusion.motion_model import Motion
from estimator.light_filter.collinear_lamps import doubt, straighten, sure_part
from estimator.measurements import Command, Order
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.covariance3 import grow_tie, hang, mend_tie
from estimator.numerics.symmetric3 import det3, invert3, largest_of, positive_part, symmetric
from estimator.result import SURPRISE, Fix, LightsResult

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel


@dataclass(frozen=True, slots=True, eq=False)
class MapShift:
    """A correction of the map frame that the map has to follow.

    Attributes:
        moved: transform of the map contents (x, y, yaw; T_new_old).
        since: ID of the first keyframe that moves.
        known: the pose in the survey is known for the first time: a restored map moves along for the last time.
    """

    moved: Array
    since: int
    known: bool = False


FRESH_M, FRESH_S = 0.7, 60.0
"""Path length (m) and time (s) after which the error of the light model (walls, ground, lamps) is independent."""

DRIFT = (5e-5, 5e-5, 2e-6)
"""Variance per metre (m^2, m^2, rad^2) of map deformation beyond the covariance of matches.

It is some 7 mm and 0.08 deg per root of a metre.
"""

ASTRAY_RAD = 0.35
"""Heading error of light, without odometry, above which its position is wrong as well, rad."""
SURPRISE_S = 1.0
"""Time (s) of disagreement after which a certain light solution is followed.

Only light can find the position in the building.
"""
TOLERANCE = np.diag((0.02**2, 0.02**2, 0.005**2))
"""Covariance of stamp and lever arm errors of a moving robot."""

APART = 1.5
"""Squared Mahalanobis distance above which pose and light are still converging to each other.

The errors of a pose that comes from light are mostly light's own. At 150 starts the distance was 0.1 (median), and
above 0.8 at one in fifty; two independent poses would give 3. Of the four above 1.5 three were wrong.
"""
FAR_M, FAR_RAD, CHECKED = 1.5, 0.5, 3
"""Separation (m, rad) of light above which it is followed although the lidar has tracked without a break.

A smaller one is reported only. The lidar does not lose so little, and light with an unusual reflection deviates by as
much. CHECKED: fewest lamps for this where the pose is known, because one of two lamps that was moved shifts the
position.
"""
SAID = np.diag((0.3**2, 0.3**2, 0.15**2))
"""Covariance of an operator pose."""
SURER = 0.25
"""Share of the pose's generalised variance below which the light solution replaces it."""


def on_motion(pose: MapPose, motion: Motion, T_before: Array, P_before: Array, t_before: float) -> None:
    """Propagate the covariance of the alignment by the motion that has just been predicted."""
    alignment = pose.alignment
    if alignment is None:
        return
    x, y, _ = (motion.T_odom_base - T_before).tolist()
    way, dt = math.hypot(x, y), motion.t_mono - t_before
    both = np.empty((2, 3, 3))
    grow_tie(
        alignment.P,
        alignment.X,
        P_before,
        motion.P,
        np.array((x, y, DRIFT[0] * way, DRIFT[1] * way, DRIFT[2] * way)),
        both,
    )
    alignment.P, alignment.X = both[0], both[1]
    alignment.way += way
    alignment.fresh = min(1.0, alignment.fresh + way / FRESH_M + (dt / FRESH_S if math.isfinite(dt) else 0.0))
    alignment.poses.add(motion.t_mono, motion.T_odom_base)


def on_match(pose: MapPose, motion: Motion, t_scan: float, before: tuple[Array, Array], lacked: Array) -> None:
    """Correct T_map_base by the part of the match's correction of T_odom_base that was its own error too.

    Args:
        pose: in the map.
        motion: after the match.
        t_scan: instant of the previous scan, s.
        before: T_odom_base and its covariance before the match.
        lacked: covariance (3, 3) that the prediction lacked (`estimator.fusion.motion_model.learn`).
    """
    alignment, (T_before, P_before) = pose.alignment, before
    if alignment is None:
        return
    alignment.broken |= blind(pose, motion)
    alignment.t_match = motion.t_mono
    alignment.scan_s = min(motion.t_mono - t_scan, SLOWEST_S)
    if not alignment.placed:
        return
    mended = np.empty((3, 3, 3))
    mend_tie(alignment.P, alignment.X, lacked, P_before, motion.P, mended)
    alignment.P, alignment.X, share = mended[0], mended[1], mended[2]
    made = motion.T_odom_base - T_before
    made[2] = se2.wrap(made[2])
    T_map_base = se2.compose(pose.T_map_odom, T_before) + se2.rotation(pose.T_map_odom[2]) @ (share @ made)
    pose.move(se2.compose(T_map_base, se2.inverse(motion.T_odom_base)), motion.T_odom_base)
    remember(pose, motion)


def remember(pose: MapPose, motion: Motion) -> None:
    """Store the pose and the covariance of the alignment: see `SurveyAlignment.kept`."""
    alignment, R = pose.alignment, se2.rotation(pose.T_map_odom[2])
    assert alignment is not None
    alignment.kept = se2.compose(pose.T_map_odom, motion.T_odom_base), R @ alignment.P @ R.T


def on_lights(
    pose: MapPose, motion: Motion, light: LightChannel, lights: LightsResult, next_key: int
) -> MapShift | None:
    """Update by a result of the light filter; returns the shift of the map with the robot, if there is one.

    ``next_key``: ID of the next keyframe.
    """
    alignment = pose.alignment
    assert alignment is not None
    alignment.gap = None
    alignment.light_s, alignment.t_light = min(lights.t_mono - alignment.t_light, SLOWEST_S), lights.t_mono
    if restarting(light, lights):
        alignment.way_young = alignment.way
    if lights.fix not in (Fix.GOOD, Fix.STARTING):
        return None
    alignment.row.take(doubt(light.filter.catalogue, lights.accepted), alignment.way)
    in_row = alignment.row.narrow(BESIDE_M)
    lights = across_the_row(
        alignment.row.left, doubted(lights, alignment.way - alignment.way_young, light.has_motion, in_row)
    )
    held = holds_heading(pose, motion, light)
    if held:
        lights = without_heading(lights)
    T_odom_base = pose_at(pose, motion, max(lights.t_mono, lights.t_pose))
    R = se2.rotation(pose.T_map_odom[2])
    P = R @ alignment.P @ R.T
    off = lights.T_map_base - se2.compose(pose.T_map_odom, T_odom_base)
    off[2] = se2.wrap(off[2])
    alignment.gap = float(off @ invert3(P + lights.covariance + TOLERANCE) @ off) if alignment.placed else None
    if (
        not alignment.placed or alignment.odd_since is not None or held
    ):  # while the lidar tracks the heading, that of light is not used
        alignment.swing.forget()
    elif lights.fix is Fix.GOOD:
        alignment.swing.take(alignment.way, float(lights.T_map_base[2] - T_odom_base[2]))
    alignment.apart, shift = False, None
    if not alignment.placed:
        shift = follow(pose, motion, lights, T_odom_base)
        alignment.gap = 0.0
    elif _contradicted(pose, motion, light, lights, off) or _surer(alignment, lights):
        shift = follow(pose, motion, lights, T_odom_base)
    else:
        alignment.apart = _apart(alignment)
        if lights.fix is Fix.GOOD and alignment.odd_since is None and not (held and abs(off[2]) > ASTRAY_RAD):
            shift = gain(pose, motion, light.on_wheels, (lights, T_odom_base, off), next_key)
    if lights.fix is Fix.GOOD and alignment.odd_since is None:
        alignment.proved, alignment.broken = True, False
        alignment.way_start = light.filter.way_start
    return shift


def on_order(pose: MapPose, motion: Motion, light: LightChannel | None, command: Command) -> None:
    """Apply an operator command to the light filter: a given pose, or a restart."""
    alignment, T_map_base = pose.alignment, command.T_map_base
    if alignment is None or light is None or command.order is Order.REMEMBERED:
        return
    if command.order is Order.RESET:
        light.reset()
        alignment.placed, alignment.proved, alignment.gap, alignment.odd_since, alignment.since = (
            False,
            False,
            None,
            None,
            0,
        )
        place_given(alignment, False)
    if T_map_base is not None and np.isfinite(T_map_base).all():
        light.place(T_map_base, SAID)
        pose.history.forget()
        R = se2.rotation(pose.T_map_odom[2])
        alignment.P = R.T @ SAID @ R
        leave(pose, motion, np.zeros((3, 3)))
        alignment.placed, alignment.proved, alignment.gap, alignment.odd_since, alignment.fresh = (
            True,
            True,
            None,
            None,
            0.0,
        )
        alignment.broken, alignment.way_start = False, light.filter.way_start
        place_given(alignment, False)
        remember(pose, motion)


def place_given(alignment: SurveyAlignment, by_map: bool) -> None:
    """Reset the comparison with light after an operator or the map has given the pose."""
    alignment.apart, alignment.by_map = False, by_map
    alignment.swing.forget()


def gain(
    pose: MapPose, motion: Motion, wheels: bool, news: tuple[LightsResult, Array, Array], next_key: int
) -> MapShift:
    """Add the information that the epoch's links have added to the light filter, as far as it is new.

    The links' own measurement, without the prior of the light filter, is ``L+ x+ - L- x-``. About the pose here that is
    ``G (x- - x) + L+ dx`` with ``G = L+ - L-`` and the correction ``dx`` that they made.

    Args:
        pose: in the map.
        motion: in the odom frame.
        wheels: whether odometry drives the light filter.
        news: the epoch's result, T_odom_base at its instant, and the difference (x, y, yaw) of light to the pose then.
        next_key: ID of the next keyframe.
    """
    alignment, (lights, T_odom_base, off) = pose.alignment, news
    assert alignment is not None
    R = se2.rotation(pose.T_map_odom[2])
    L_lights = invert3(lights.covariance)
    most = largest_of(lights.gained, lights.covariance)
    part = min(1.0, alignment.fresh / most) if most > 0.0 and not blind(pose, motion) else 1.0
    alignment.fresh = max(0.0, alignment.fresh - part * max(most, 0.0))  # may exceed what is new
    G = part * lights.gained
    told = G @ (off - lights.gained_by) + part * (L_lights @ lights.gained_by)
    if not wheels:
        alignment.P, alignment.X = straighten(alignment.P, alignment.X)
    before = R @ alignment.P @ R.T
    L_before = invert3(before)
    after = symmetric(invert3(L_before + positive_part(G)))
    keep = R.T @ after @ L_before @ R
    alignment.P = R.T @ after @ R
    leave(pose, motion, keep)
    shift = correct(pose, se2.compose(pose.T_map_odom, T_odom_base) + after @ told, T_odom_base, motion.T_odom_base)
    if np.all(np.diag(after) < KNOWN):
        shift = replace(shift, known=alignment.since == 0)
        alignment.since = next_key
    return shift


def follow(pose: MapPose, motion: Motion, lights: LightsResult, T_odom_base: Array) -> MapShift:
    """Set the pose to the light solution."""
    alignment = pose.alignment
    assert alignment is not None
    pose.history.forget()
    shift = correct(pose, lights.T_map_base, T_odom_base, motion.T_odom_base)
    R = se2.rotation(pose.T_map_odom[2])
    alignment.P = R.T @ lights.covariance @ R
    leave(pose, motion, np.zeros((3, 3)))
    alignment.placed, alignment.odd_since, alignment.fresh, alignment.by_map = True, None, 0.0, False
    remember(pose, motion)
    return shift


def hang_on_anchor(pose: MapPose, motion: Motion) -> None:
    """Set the alignment's covariance to that of the anchor, propagated to here: the pose then comes from the map."""
    alignment, P = pose.alignment, np.empty((3, 3))
    assert alignment is not None
    hang(pose.T_odom_anchor, motion.T_odom_base, pose.P_anchor, motion.P, 0.0, P)
    alignment.P, alignment.X = P, motion.P.copy()
    alignment.mended.clear()


def leave(pose: MapPose, motion: Motion, keep: Array) -> None:
    """Scale the alignment's error, and its covariance with the pose's, by ``keep`` (3x3, odom-aligned axes)."""
    alignment, now = pose.alignment, motion.t_mono
    assert alignment is not None
    alignment.X = keep @ alignment.X
    alignment.mended.append((now, keep))
    while now - alignment.mended[0][0] > KEPT_S:
        alignment.mended.popleft()


def correct(pose: MapPose, T_map_base: Array, T_odom_base: Array, T_odom_now: Array) -> MapShift:
    """Move the map frame so that the robot, now at ``T_odom_now``, was at ``T_map_base`` when at ``T_odom_base``.

    Keyframes created since the pose was last known move along; older ones stay.
    """
    assert pose.alignment is not None
    T_map_odom = se2.compose(T_map_base, se2.inverse(T_odom_base))
    shift = MapShift(se2.compose(T_map_odom, se2.inverse(pose.T_map_odom)), pose.alignment.since)
    pose.move(T_map_odom, T_odom_now)
    return shift


def _contradicted(pose: MapPose, motion: Motion, light: LightChannel, lights: LightsResult, off: Array) -> bool:
    """Whether light has disagreed with the pose for long enough, and by enough, to be followed.

    A light filter that still searches does not contradict a confirmed pose under tracking. Nor does a difference
    smaller than the lidar could have lost. Nor does one lamp beside collinear others, seen briefly: it does not correct
    the error that they have caused.
    """
    alignment = pose.alignment
    assert alignment is not None
    if alignment.gap is None or alignment.gap <= SURPRISE:
        alignment.odd_since = None
        return False
    alignment.odd_since = lights.t_mono if alignment.odd_since is None else alignment.odd_since
    held = alignment.proved and not alignment.broken and not blind(pose, motion)
    away, turn = sure_part(off, lights.covariance)
    far = away > FAR_M or (
        turn > FAR_RAD and not holds_heading(pose, motion, light) and _elsewhere(pose, motion, light)
    )
    checked = len(lights.accepted) >= CHECKED or bool(np.any(np.diag(alignment.P) >= KNOWN))
    if held and not (far and lights.fix is Fix.GOOD and checked):
        alignment.doubted_at = lights.t_mono
    return lights.t_mono - max(alignment.odd_since, alignment.doubted_at) >= SURPRISE_S


def _apart(alignment: SurveyAlignment) -> bool:
    """Whether pose and light disagree, or agree while one still converges to the other.

    A pose from the map is independent of light, so their distance varies randomly.
    """
    assert alignment.gap is not None
    if alignment.odd_since is not None or alignment.by_map:
        return alignment.odd_since is not None
    return alignment.gap > APART or not alignment.swing.rests


def _elsewhere(pose: MapPose, motion: Motion, light: LightChannel) -> bool:
    """Whether light has restarted its position search since the last agreement, or receives an impossible lamp.

    Otherwise odometry or collinear lamps have biased only its heading. The lidar tracks its own heading, and no link
    contradicts the position.
    """
    assert pose.alignment is not None
    assert light is not None
    if light.filter.way_start > pose.alignment.way_start:
        return True
    from estimator.light_filter.light_channel import too_strong_at  # only where there is a photodiode

    return any(too_strong_at(light, se2.compose(pose.T_map_odom, motion.T_odom_base)))


def _surer(alignment: SurveyAlignment, lights: LightsResult) -> bool:
    """Whether the covariance of the light solution is so much smaller that it can replace the pose."""
    return alignment.odd_since is None and det3(lights.covariance) < SURER * det3(alignment.P)
