"""Keyframe selection: when a keyframe is created, the local map update by it, and which keyframes are removed."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import islice

import numpy as np

from estimator.fusion.light_witness import blind
from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion
from estimator.mapping import keyframe
from estimator.mapping.keyframe import SIZE, Keyframe, Submap, near, square_of, squares_about
from estimator.mapping.map_state import MappingSettings, MapState
from estimator.mapping.submap_graph import OWN
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import MapSettings
from estimator.scan_matching.match_memory import MatchMemory

PATIENCE = 3
"""Consecutive scans without a match before the local map restarts from the present one."""

PATIENCE_S = 1.0
"""With odometry that takes at least so long, s: odometry bridges it, and people before the lidar step away again."""

BLOCKED_M, BLOCKED_RAD = 2.0, 1.05
"""With odometry, motion (m, rad) since the latest match after which another part of a room is seen.

Until then a blocked view is more probable than a new one.
"""

NEAR = 0.4
"""Smallest distance of keyframes, in steps: a robot at rest that trembles creates none."""

PASS = SIZE
"""Keyframes that separate two passes of one position: 3 m of path or half a turn, well beyond what is near."""

AGAIN = 8
"""Squares that are listed again with each keyframe."""

NOTHING = 1e-9 * np.eye(3)


def keyframe_due(
    map_: MapState, pose: MapPose, motion: Motion, matching: MatchMemory, match: MatchResult, every_step: bool
) -> bool:
    """Whether the robot has left its newest keyframe, sees something else, or has lost its local map.

    Args:
        map_: the map to extend.
        pose: relative to the newest keyframe.
        motion: after the match.
        matching: after the match.
        match: of the present scan.
        every_step: keyframes follow the count of :func:`count_steps`, not their distance alone.
    """
    settings = map_.settings
    if matching.local_map is None or not match.ok:
        return lost(motion, matching, every_step)
    changed = match.inliers < settings.keyframe_share * match.queries and matching.scans_since_keyframe >= PATIENCE
    if not every_step:  # the newest keyframe is the whole map, and its error stays for good
        return changed or away(map_, pose, motion) > 1.0
    step = math.floor(matching.steps)
    due = changed or (step != map_.newest_step and away(map_, pose, motion) > NEAR)
    map_.newest_step = step if due else map_.newest_step
    return due


def lost(motion: Motion, matching: MatchMemory, every_step: bool) -> bool:
    """Whether there is no local map, or no usable scan has matched it for long enough.

    A map of one keyframe (``every_step`` False) is soon out of view.
    """
    if matching.local_map is None:
        return True
    waited = motion.t_mono - matching.t_match
    if not motion.odometry:
        return matching.failures >= PATIENCE
    x, y, yaw = se2.between(matching.T_odom_match, motion.T_odom_base).tolist()
    gone = math.hypot(x, y) > BLOCKED_M or abs(yaw) > BLOCKED_RAD
    at_rest = motion.t_mono - motion.t_stood >= PATIENCE_S
    return matching.failures >= PATIENCE and waited >= PATIENCE_S and (gone or at_rest or not every_step)


def away(map_: MapState, pose: MapPose, motion: Motion) -> float:
    """Distance of the robot from its newest keyframe, in keyframes: the larger one of path and rotation."""
    x, y, yaw = se2.between(pose.T_odom_anchor, motion.T_odom_base).tolist()
    return float(max(math.hypot(x, y) / map_.settings.keyframe_m, abs(yaw) / map_.settings.keyframe_rad))


def count_steps(settings: MappingSettings, motion: Motion, matching: MatchMemory) -> None:
    """Add the predicted path since the last scan, in keyframe distances, to the step count.

    A keyframe is created where this count passes a whole number, not at a distance from the last one. So a tiny
    difference in one match does not select other scans, and with them another map.
    """
    x, y, yaw = se2.between(matching.T_odom_scan, motion.T_odom_base).tolist()
    matching.steps += math.hypot(x, y) / settings.keyframe_m + abs(yaw) / settings.keyframe_rad


def make_keyframe(map_: MapState, pose: MapPose, motion: Motion, scan: Scan, turned_rad: float) -> Keyframe:
    """Keyframe of a scan at the present pose, without a submap of the graph yet."""
    T = motion.T_odom_base
    frame = keyframe.keep(map_.next_key, pose.here(T), T, scan, turned_rad)
    newest = map_.keyframes.get(pose.anchor)
    if newest is not None and np.array_equal(newest.bearing_rad, frame.bearing_rad):
        frame.bearing_rad = newest.bearing_rad
    return frame


def hang_on(map_: MapState, pose: MapPose, motion: Motion, frame: Keyframe) -> Array:
    """Make a new keyframe the anchor; returns the pose's covariance (3, 3) since the previous keyframe."""
    P, T = motion.P, motion.T_odom_base
    pose.P_anchor = turned_back(pose, pose.covariance(T, P))
    motion.P = NOTHING.copy()
    if pose.alignment is not None:
        pose.alignment.X = np.zeros((3, 3))
    map_.keyframes[frame.key] = frame
    pose.anchor, pose.T_odom_anchor, map_.next_key = frame.key, T, frame.key + 1
    return P


def lay_anchor(map_: MapState, pose: MapPose, motion: Motion) -> None:
    """Create an anchor without a scan where light alone gives the pose, once per keyframe distance."""
    alignment, T = pose.alignment, motion.T_odom_base
    near = away(map_, pose, motion) <= 1.0
    if alignment is None or not alignment.placed or not blind(pose, motion) or near:
        return
    if map_.settings.history:
        map_.light_anchors[map_.next_key] = Submap(0, map_.next_key, pose.here(T), T)
    pose.anchor, pose.T_odom_anchor, map_.next_key = map_.next_key, T, map_.next_key + 1


def turned_back(pose: MapPose, P_map: Array) -> Array:
    """A covariance of the map frame in the axes of the odom frame."""
    R = se2.rotation(-pose.T_map_odom[2])
    return np.asarray(R @ P_map @ R.T)


def update_local_map(
    matching: MatchMemory, newest: Keyframe, points: ScanPoints, settings: MapSettings, noise_m: float, anew: bool
) -> None:
    """Merge the newest keyframe into the local map, or restart it (``anew``) where the old one is lost."""
    local = matching.local_map
    if local is None or anew:
        matching.restarts += local is not None
        local = local_map.empty(newest.T_odom_keyframe[:2])
    matching.local_map = local_map.update(local, newest, lines_of(points), settings, noise_m)
    matching.failures = 0


def retire(map_: MapState, newest: Keyframe) -> None:
    """Limit the stored scans per area: near one position and heading, the newest few of earlier passes stay.

    Keyframes of the present pass do not count: in a curve, or where the robot sways, they lie close together. A count
    by list square instead would fill squares that a lap only touches, for hours.
    """
    T, parts = newest.T_map_keyframe, map_.parts
    # what is detached, or on trial, may lie elsewhere: it replaces no older one
    fixed, on_trial = parts.session_start if parts.fixed else 0, 0 if parts.trial is None else parts.trial.since
    since = max(parts.detached_since, fixed, on_trial)
    here = sorted(key for key, T_key in listed(map_, T, newest.key) if since <= key and near(T, T_key))
    earlier = [key for key in here if key <= newest.key - PASS]
    for key in earlier[: max(0, len(earlier) + 1 - map_.settings.keep)]:
        drop(map_, key)
    if parts.fixed:
        own = [key for key in map_.keyframes if key >= parts.session_start]
        for key in own[: -OWN * SIZE]:
            drop(map_, key)


def listed(map_: MapState, T_map: Array, newest: int) -> Iterator[tuple[int, Array]]:
    """The newest keyframe and those near it, with their poses; each is listed again at its present square.

    A few of those not listed for the longest time follow. A small rotation of the map moves its far end by metres.
    There the next pass would miss them.
    """
    about = [newest]
    for square in (*squares_about(T_map), *islice(map_.places, AGAIN)):
        about += map_.places.pop(square, ())
    for key in about:
        frame = map_.keyframes.get(key)
        if frame is not None:
            T_key = frame.T_map_keyframe
            map_.places.setdefault(square_of(T_key), []).append(key)
            yield key, T_key


def drop(map_: MapState, key: int) -> None:
    """Remove a keyframe's scan."""
    gone = map_.keyframes.pop(key)
    if map_.settings.history:
        map_.retired[key] = gone.submap, se2.between(gone.submap.T_odom_submap, gone.T_odom_keyframe)
