"""The method, as one readable step: predict -> virtual frame -> match -> fuse -> keyframe -> map."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from estimator import grid, localmap, matching, motion, se2
from estimator.grid import Grid
from estimator.matching import Prior, View
from estimator.records import Array, Command, Imu, Limits, Odometry, Order, Record, Scan
from estimator.result import MatchResult, Reason, StepResult
from estimator.scanpoints import ScanPoints, points_of
from estimator.state import Settings, State, new_state

__all__ = ["Settings", "State", "keyframe_poses", "new_state", "render_map", "step"]

JUMP_M, JUMP_RAD = 0.05, np.radians(1.0)
TINY = 1e-9 * np.eye(3)
LEAST_NOISE_M = 0.004
LEARNING, CAUCHY = 0.02, 0.807


def step(state: State, records: Iterable[Record], limits: Limits) -> StepResult:
    """Take the records since the last step, in the order in which they were true, and return the pose after them.

    Never raises for what a sensor delivers: a scan that cannot be matched leaves the prediction and says why.
    """
    match: MatchResult | None = None
    keyframe = -1
    for record in sorted(records, key=order):
        predict(state, record)
        if isinstance(record, Scan):
            points = virtual_frame(state, record)
            match = match_scan(state, record, points, limits)
            fuse(state, match)
            if limits.update_map and keyframe_due(state, points):
                keyframe = lay_keyframe(state, record, points)
                update_map(state)
    return report(state, match, keyframe)


def order(record: Record) -> tuple[float, bool]:
    """Records go by the instant up to which they speak; a scan after whatever moved the robot until then."""
    end = record.t_end if isinstance(record, Scan | Odometry | Imu) else record.t_begin
    return end, isinstance(record, Scan)


def predict(state: State, record: Record) -> None:
    """Bring the pose to the record's instant: by odometry, by gyro, else at constant velocity; obey a command."""
    noise = state.settings.noise
    match record:
        case Odometry():
            motion.on_odometry(state.motion, record, noise)
        case Imu():
            motion.carry_to(state.motion, record.t_begin, noise)
            motion.on_imu(state.motion, record)
            motion.carry_to(state.motion, record.t_end, noise)
        case Scan():
            motion.carry_to(state.motion, record.t_end, noise)
        case Command():
            obey(state, record)


def virtual_frame(state: State, scan: Scan) -> ScanPoints:
    """Eq. 10-11: filter the beams (Q, L) and carry each from its own instant to the scan's end."""
    moved = se2.exp(state.motion.velocity * max(0.0, scan.t_end - scan.t_begin))
    return points_of(scan, moved, state.settings.far_m, state.settings.quality)


def match_scan(state: State, scan: Scan, points: ScanPoints, limits: Limits) -> MatchResult:
    """Eq. 12-14: nearest neighbours on the distance axis, point-to-line, the prediction weighted in."""
    T_pred, count = state.motion.T_odom_base, len(points.xy)
    if state.local is None:
        return matching.no_match(T_pred, count, Reason.NO_MAP)
    if count < state.settings.matching.min_points:
        return matching.no_match(T_pred, count, Reason.TOO_FEW_POINTS)
    thin = max(1, -(-count // max(1, limits.points)))
    xy = np.ascontiguousarray(points.xy[::thin])
    view = View(xy, scan, noise_of(state, scan))
    L1 = se2.invert(state.motion.P)
    return matching.match(view, state.local, Prior(T_pred, L1), limits.icp_iterations, state.settings.matching)


def fuse(state: State, match: MatchResult) -> None:
    """Take the matched pose and add its information; without odometry it also tells the velocity."""
    moving = state.motion
    if match.ok:
        learn_noise(state, match)
        moving.T_odom_base = match.T_odom_base
        P = moving.P * motion.learn(moving, match.correction, bool(match.known_axes.all()))
        moving.P = se2.invert(se2.invert(P) + match.information)
        dt = moving.t_mono - state.t_scan
        if not moving.odometry and 1e-3 < dt < motion.LONGEST_CARRY_S:
            moving.velocity = se2.log(se2.between(state.T_odom_scan, moving.T_odom_base)) / dt
    state.t_scan, state.T_odom_scan = moving.t_mono, moving.T_odom_base


def noise_of(state: State, scan: Scan) -> float:
    """Range noise to reckon with: what residuals have shown, within a factor of three of the device's own figure."""
    stated = max(scan.sigma_m, LEAST_NOISE_M)
    return min(max(state.noise_m or stated, stated / 3.0, LEAST_NOISE_M), 3.0 * stated)


def learn_noise(state: State, match: MatchResult) -> None:
    """Follow the residuals; ``CAUCHY`` is what the robust weights leave of a Gaussian's variance."""
    square = match.residual_m**2 / CAUCHY
    state.noise_m = (
        float(np.sqrt((1.0 - LEARNING) * state.noise_m**2 + LEARNING * square)) if state.noise_m else match.residual_m
    )


def keyframe_due(state: State, points: ScanPoints) -> bool:
    """Whether the robot has left its newest keyframe (or has none) and sees enough to lay another."""
    settings = state.settings
    if len(points.xy) < settings.matching.min_points:
        return False
    away = se2.between(state.T_odom_anchor, state.motion.T_odom_base)
    far = np.hypot(away[0], away[1]) > settings.keyframe_m or abs(away[2]) > settings.keyframe_rad
    return state.local is None or bool(far)


def lay_keyframe(state: State, scan: Scan, points: ScanPoints) -> int:
    """Keep this scan and hang the coming poses on it; returns its ID."""
    moving, key = state.motion, state.next_key
    T = moving.T_odom_base
    frame = localmap.keyframe_of(key, se2.compose(state.T_map_odom, T), T, points, scan)
    state.P_anchor = covariance(state)
    moving.P = TINY.copy()
    state.keyframes[key] = frame
    state.anchor, state.T_odom_anchor, state.next_key = key, T, key + 1
    return key


def update_map(state: State) -> None:
    """Merge the newest keyframe into the local map, and index it around the place where it was laid."""
    newest = state.keyframes[state.anchor]
    local = state.local or localmap.empty(newest.T_odom_keyframe[:2])
    state.local = localmap.update(local, newest, state.settings.map, noise_of(state, newest.scan))


def obey(state: State, command: Command) -> None:
    """SET_POSE moves the whole map so that the robot stands there; RESET forgets the map and starts at the origin."""
    T_map_base = command.T_map_base
    if command.order is Order.RESET:
        state.keyframes, state.local = {}, None
        state.P_anchor = state.motion.P = TINY.copy()
        state.anchor, state.T_odom_anchor = 0, state.motion.T_odom_base
        T_map_base = se2.identity() if T_map_base is None else T_map_base
        state.T_map_start = T_map_base
    if T_map_base is None or not np.isfinite(T_map_base).all():
        return
    T_map_odom = se2.compose(T_map_base, se2.inverse(state.motion.T_odom_base))
    moved = se2.compose(T_map_odom, se2.inverse(state.T_map_odom))
    if command.order is Order.SET_POSE:
        state.T_map_start = se2.compose(moved, state.T_map_start)
        for frame in state.keyframes.values():
            frame.T_map_keyframe = se2.compose(moved, frame.T_map_keyframe)
    was = se2.compose(state.T_map_odom, state.motion.T_odom_base)
    shift = se2.between(was, T_map_base)
    state.jumps += int(np.hypot(shift[0], shift[1]) > JUMP_M or abs(shift[2]) > JUMP_RAD)
    state.T_map_odom = T_map_odom


def covariance(state: State) -> Array:
    """3x3 covariance of T_map_base: of the anchor, swung out to here, and of the pose relative to it."""
    away = se2.between(state.T_odom_anchor, state.motion.T_odom_base)
    P = se2.carry(state.T_odom_anchor, away, state.P_anchor) + state.motion.P
    R = se2.rotation(state.T_map_odom[2])
    return np.asarray(R @ P @ R.T)


def report(state: State, match: MatchResult | None, keyframe: int) -> StepResult:
    """The estimate after this step."""
    moving = state.motion
    return StepResult(
        t_mono=moving.t_mono,
        T_odom_base=moving.T_odom_base,
        T_map_odom=state.T_map_odom,
        covariance=covariance(state),
        velocity=moving.velocity,
        known_axes=np.ones(3) if match is None else match.known_axes,
        match=match,
        keyframe=keyframe,
        loop=None,
        anchor=state.anchor,
        T_anchor_base=se2.between(state.T_odom_anchor, moving.T_odom_base),
        jumps=state.jumps,
    )


def keyframe_poses(state: State) -> dict[int, Array]:
    """``T_map_keyframe`` of every keyframe by ID, as corrected so far; 0 is the start."""
    return {0: state.T_map_start} | {key: frame.T_map_keyframe for key, frame in state.keyframes.items()}


def render_map(state: State, resolution: float) -> Grid:
    """Occupancy grid of all keyframes at their present places, ``resolution`` metres per cell (see `grid.render`)."""
    return grid.render(list(state.keyframes.values()), resolution)
