"""One estimator step: predict, light filter, virtual frame, scan match, fusion, keyframe, map update."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from estimator.commands import obey
from estimator.fusion import (
    gyro_calibration,
    map_odom_filter,
    motion_model,
    mount_correction,
    out_of_sequence,
    protection_level,
    time_offset,
    wheel_calibration,
)
from estimator.fusion.laser_odometry import guide
from estimator.fusion.light_witness import KNOWN, virtual
from estimator.fusion.pose_update import beams_per_sample, fuse, learn_correlation, loose_direction, noise_of
from estimator.mapping import live_grid, loop_closure
from estimator.mapping.keyframe import hanging
from estimator.mapping.keyframe_selection import (
    count_steps,
    hang_on,
    keyframe_due,
    lay_anchor,
    lost,
    make_keyframe,
    retire,
    update_local_map,
)
from estimator.mapping.map_frame import relist, shift_map
from estimator.mapping.occupancy_grid import Grid
from estimator.measurements import (
    UNLIMITED,
    Answer,
    Command,
    DegradationLevel,
    Imu,
    Lap,
    LightEpoch,
    Limits,
    Odometry,
    Record,
    SampleBlock,
    Scan,
    no_lap,
)
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation import (
    kidnap_detection,
    kidnap_opportunity,
    relocalisation,
    relocalisation_check,
    unaligned_map,
)
from estimator.result import LightsResult, MatchResult, Reason, StepResult
from estimator.scan_matching import scan_matcher, scan_validation
from estimator.scan_matching.deskew import ScanPoints, oriented, points_of, unturned
from estimator.scan_matching.scan_matcher import Asked, Prior, View
from estimator.scan_matching.scan_validation import in_time, nothing_of, refused
from estimator.state import Settings, State, new_state

__all__ = ["Settings", "State", "keyframe_poses", "new_state", "render_map", "step"]


FLOOR = np.diag((0.005**2, 0.005**2, 0.003**2))
"""Covariance of errors outside every filter: stamps, scan duration and mount of a moving robot."""


def step(state: State, records: Iterable[Record], limits: Limits, lap: Lap = no_lap) -> StepResult:
    """Process the records since the last step, in time order (`in_turn`), and return the resulting pose.

    It raises nothing for any sensor data: a scan without a match leaves the prediction, and the result has the reason.
    """
    result: MatchResult | None = None
    keyframe = -1
    if mount_correction.correct(state.wheels, state.motion, state.matching, state.pose):
        state.time_offset.forget()
    for record in in_turn(state, records):
        refusal = refused(state.matching, record) if isinstance(record, Scan) else None
        if refusal is None:
            predict(state, record)
        match record:
            case SampleBlock() | LightEpoch():
                see_light(state, record)
                lap("lights")
            case Answer():
                loop_closure.take_answer(state.map, state.pose, state.motion, record)
                lap("map")
            case Scan():
                result, laid = see_scan(state, record, limits, refusal or passed_over(state, record, limits), lap)
                keyframe = max(keyframe, laid)
    lap("step")
    look_for_lamps(state, limits)
    lap("search")
    relocalisation.step_done(state)
    unaligned_map.step_done(state)
    return report(state, result, keyframe, limits)


def see_scan(state: State, scan: Scan, limits: Limits, refusal: Reason | None, lap: Lap) -> tuple[MatchResult, int]:
    """Match a scan at the pose of its own instant and re-propagate; returns the match, and a keyframe ID or -1."""
    scan = mount_correction.remounted(state.wheels, scan)
    if refusal is not None or not out_of_sequence.late(state.motion, scan):
        return see(state, scan, limits, refusal, lap)
    ahead = out_of_sequence.go_back(state.pose, state.motion, scan)
    seen = see(state, scan, limits, refusal, lap)
    out_of_sequence.come_again(state.pose, state.motion, ahead)
    return seen


def see(state: State, scan: Scan, limits: Limits, refusal: Reason | None, lap: Lap) -> tuple[MatchResult, int]:
    """Match a scan at the pose, fuse it, and create a keyframe where one is due; returns the match, an ID or -1."""
    points = nothing_of(scan) if refusal else virtual_frame(state, scan)
    count_steps(state.settings, state.motion, state.matching)
    match = match_scan(state, scan, points, limits, refusal)
    suspected = kidnap_detection.raised(state, scan, points, match)
    fuse_match(state, scan, match)
    if suspected:
        kidnap_detection.look(state, scan, points, match)
    lap("match")
    if not (limits.update_map and limits.level < DegradationLevel.NO_MAP and extends_map(state, points, match)):
        return match, -1
    keyframe = extend_map(state, scan, points, limits, match)
    lap("map")
    return match, keyframe


def fuse_match(state: State, scan: Scan, match: MatchResult) -> None:
    """Eq. 14-15: update the pose by a match, the light filter by its motion, and the time offset."""
    calibrated = state.settings.calibrate and state.motion.odometry
    if calibrated and match.ok:
        variance = float(state.motion.P[2, 2]) + 1.0 / max(float(match.information[2, 2]), 1e-9)
        wheel_calibration.on_heading(
            state.wheels, float(match.correction[2]), variance, float(state.motion.velocity[2])
        )
    more = fuse(state.pose, state.motion, state.matching, match, state.settings.noise)
    if more is not None:  # the path too, or no loop could join submaps again
        state.map.graph.loosen(more, state.pose.T_odom_anchor)
    guide(state.light, state.motion, match)
    time_offset.on_match(state.time_offset, scan, match)
    if state.settings.calibrate:
        complete = match.ok and bool(match.known_axes.all()) and loose_direction(match.information) is None
        if match.ok and match.known_axes[2]:
            gyro_calibration.on_match(state.wheels.gyro, state.motion.t_mono, float(match.T_odom_base[2]))
        wheel_calibration.on_match(state.wheels, state.motion.t_mono, state.motion.T_odom_base, complete)


def extends_map(state: State, points: ScanPoints, match: MatchResult) -> bool:
    """Whether a keyframe is due; never with too few points, nor by scans that cannot be trusted."""
    if (match.ok and kidnap_detection.waits(state)) or len(points.xy) < state.settings.matching.min_points:
        return False
    if not match.ok and (kidnap_opportunity.blocked(state) or relocalisation.lidar_is_wrong(state)):
        return False
    every_step = not state.settings.newest_only
    return keyframe_due(state.map, state.pose, state.motion, state.matching, match, every_step)


def extend_map(state: State, scan: Scan, points: ScanPoints, limits: Limits, match: MatchResult) -> int:
    """Sect. 4.3: keep a scan as a keyframe and merge it into the local map; returns its ID."""
    map_, pose, motion, matching = state.map, state.pose, state.motion, state.matching
    if match.ok:
        learn_correlation(matching, oriented(points, limits.points), motion.T_odom_base)
    frame = make_keyframe(map_, pose, motion, scan, points.turned_rad)
    noise_m, anew = noise_of(matching, scan), lost(motion, matching, not state.settings.newest_only)
    light_pose = state.settings.light_pose
    frame.virtual = virtual(pose, motion, state.light) if light_pose is None else light_pose()
    if anew and matching.local_map is not None:
        relocalisation.local_map_lost(state)
    P = hang_on(map_, pose, motion, frame)
    matching.scans_since_keyframe = 0
    loop_closure.add_keyframe(map_, pose, frame, (P, noise_m, anew))
    for searched in (relocalisation, relocalisation_check, unaligned_map):
        searched.keyframe_laid(state, frame)
    if anew and pose.alignment is not None:
        pose.alignment.broken = True
    update_local_map(matching, frame, points, state.settings.map, noise_m, anew)
    retire(map_, frame)
    return frame.key


def passed_over(state: State, scan: Scan, limits: Limits) -> Reason | None:
    """Reason to skip the match of a scan in this step, None to match: the lidar is skipped, or the scan is too old."""
    if limits.level >= DegradationLevel.CARRIED:
        return Reason.PASSED_OVER
    return Reason.LATE if out_of_sequence.too_old(state.motion, scan) else None


def order(record: Record) -> tuple[float, bool]:
    """Sort key of records: the end of their interval; a scan follows the records that moved the robot until then."""
    end = record.t_end if isinstance(record, Scan | SampleBlock | LightEpoch | Odometry | Imu) else record.t_begin
    return end if in_time(end) else -math.inf, isinstance(record, Scan)


def in_turn(state: State, records: Iterable[Record]) -> list[Record]:
    """Records in the order of their processing; with lidar odometry, light epochs follow their scan.

    The robot's motion since the previous scan is known only after the match. Before it, light would be compared with
    the extrapolation by the velocity. For a robot that is suddenly pushed and turned, that extrapolation is worse than
    light. The resulting position error would turn its heading. No epoch waits without a scan, nor for a scan after a
    later command.
    """
    told = sorted(records, key=order)
    guided = state.light is not None and state.light.guided is not None
    if not guided or not any(isinstance(record, Scan) for record in told):
        return told
    waiting: list[Record] = []
    taken: list[Record] = []
    for record in told:
        match record:
            case SampleBlock() | LightEpoch():
                waiting.append(record)
            case Scan():
                taken += [record, *waiting]
                waiting = []
            case Command():
                taken += [*waiting, record]
                waiting = []
            case _:
                taken.append(record)
    return taken + waiting


def predict(state: State, record: Record) -> None:
    """Predict the pose to the record's instant: by odometry, by gyro, else at constant velocity; execute a command."""
    if order(record)[0] == -math.inf:
        return  # no valid instant
    noise = state.settings.noise
    if isinstance(record, Imu) and state.settings.calibrate and not gyro_calibration.usable(state.wheels.gyro, record):
        return
    before = state.motion.T_odom_base, state.motion.P, state.motion.t_mono
    if state.light is not None:
        state.light.predict(record)
    match record:
        case Odometry():
            motion_model.on_odometry(state.motion, wheel_calibration.corrected(state.wheels, record), noise)
            wheel_calibration.on_odometry(state.wheels, record)
            scan_validation.on_odometry(state.matching, record)
            time_offset.on_odometry(state.time_offset, record)
            kidnap_detection.on_odometry(state, record)
        case Imu():
            motion_model.on_imu(state.motion, record, noise)
        case Scan() | SampleBlock() | LightEpoch():
            motion_model.carry_to(state.motion, record.t_end, noise)
        case Command():
            obey(state, record)
            map_odom_filter.on_order(state.pose, state.motion, state.light, record)
            return  # RESET resets the odometry's covariance: that is no motion
    map_odom_filter.on_motion(state.pose, state.motion, *before)


def see_light(state: State, record: SampleBlock | LightEpoch) -> None:
    """Eq. 1-7: decode a block, update the light filter with its links, and the pose with the new information.

    Without a photodiode in the setup the record is ignored.
    """
    if state.light is not None:
        fuse_light(state, state.light.take(record))
    lay_anchor(state.map, state.pose, state.motion)


def fuse_light(state: State, lights: LightsResult) -> None:
    """Correct T_map_odom by a light result; keyframes created since the pose was last known move along."""
    assert state.light is not None
    map_, pose = state.map, state.pose
    shift = map_odom_filter.on_lights(pose, state.motion, state.light, lights, map_.next_key)
    if shift is None:
        return
    shift_map(map_, shift.moved, max(shift.since, map_.parts.detached_since))
    if shift.known and map_.parts.session_start:  # a stored map has moved along for the last time
        relist(map_, 0)


def look_for_lamps(state: State, limits: Limits) -> None:
    """Continue the acquisition of lamps, within the cap of this cycle."""
    if state.light is not None:
        state.light.look_on(limits.codes)


def virtual_frame(state: State, scan: Scan) -> ScanPoints:
    """Eq. 10-11: filter the beams (Q, L) and deskew them to the scan's end."""
    moved = se2.exp(state.motion.velocity * max(0.0, scan.t_end - scan.t_begin))
    return points_of(scan, moved, state.settings.far_m, state.settings.quality)


def match_scan(
    state: State, scan: Scan, points: ScanPoints, limits: Limits, refusal: Reason | None = None
) -> MatchResult:
    """Eq. 12-14: nearest neighbours on the distance axis, the scan matcher, the prediction weighted in."""
    state.matching.scans_since_keyframe += 1
    T_pred, count = state.motion.T_odom_base, len(points.xy)
    asked: Asked | None = None
    if refusal is not None:
        result = scan_matcher.no_match(T_pred, count, refusal)
    elif state.matching.local_map is None:
        result = scan_matcher.no_match(T_pred, count, Reason.NO_MAP)
    elif count < state.settings.matching.min_points:
        result = scan_matcher.no_match(T_pred, count, Reason.TOO_FEW_POINTS)
    else:
        beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
        view = View(
            oriented(points, limits.points),
            scan.T_base_lidar,
            beams,
            noise_of(state.matching, scan),
            beams_per_sample(state.matching),
        )
        prior = Prior(T_pred, invert3(state.motion.P))
        asked = (view, state.matching.local_map, prior, limits.icp_iterations, state.settings.matching)
        result = state.settings.match(*asked)
    if state.journal is not None:
        traced = state.settings.match is scan_matcher.match
        state.journal(scan, points, asked if traced else None, result)
    return result


def report(state: State, match: MatchResult | None, keyframe: int, limits: Limits = UNLIMITED) -> StepResult:
    """The estimate after this step; jobs wait for a cycle that updates the map."""
    motion, pose, map_ = state.motion, state.pose, state.map
    alignment, P = pose.alignment, pose.covariance(motion.T_odom_base, motion.P)
    total = P + np.diag((0.0, 0.0, state.wheels.doubt))
    return StepResult(
        t_mono=motion.t_mono,
        T_odom_base=motion.T_odom_base,
        T_map_odom=pose.T_map_odom,
        covariance=total + FLOOR,
        velocity=motion.velocity.copy(),
        known_axes=known_axes(state, match, P),
        match=match,
        keyframe=keyframe,
        loop=map_.graph.take_news(),
        anchor=pose.anchor,
        T_anchor_base=se2.between(pose.T_odom_anchor, motion.T_odom_base),
        jumps=pose.jumps,
        lights=None if state.light is None else state.light.result,
        placed=alignment is not None and alignment.placed,
        gap=None if alignment is None else alignment.gap,
        places=relocalisation.places(state),
        dead_reckoned=relocalisation.dead_reckons(state),
        apart=alignment is not None and alignment.apart,
        misplaced=misplaced(state),
        aside=map_.parts.aside is not None,
        let_go=state.relocalisation.maps_dropped,
        lag=state.time_offset.told,
        slow=state.wheels.told,
        jumped=math.sqrt(state.wheels.doubt),
        gyro=state.wheels.gyro.told,
        jobs=state.jobs.take() if limits.level < DegradationLevel.NO_MAP else (),
        anew=state.matching.restarts,
        protection=protection_level.bound(pose, motion, state.light, state.matching, total, state.wheels.mount_rad),
    )


def misplaced(state: State) -> bool:
    """Whether the links are impossible at the pose; see `light_evidence.misplaced`."""
    alignment = state.pose.alignment
    if alignment is None or not alignment.placed:
        return False
    from estimator.relocalisation import light_evidence  # costs nothing where there is no photodiode

    return light_evidence.misplaced(state.light, alignment, state.pose.here(state.motion.T_odom_base))


def known_axes(state: State, match: MatchResult | None, P: Array) -> Array:
    """The axes known in the map frame: in the survey by the pose's covariance ``P``, else those of the match.

    A corridor along x of the odom frame may run along y of the map.
    """
    if state.pose.alignment is not None and state.pose.alignment.placed:
        return np.asarray(P.diagonal() < KNOWN, dtype=np.float64)
    if match is None or not match.ok:
        return np.ones(3) if match is None else match.known_axes
    R = se2.rotation(state.pose.T_map_odom[2])
    return scan_matcher.known_axes(R @ match.information @ R.T)


def keyframe_poses(state: State) -> dict[int, Array]:
    """``T_map_keyframe`` by ID with all corrections so far, 0 being the start; removed ones only with history."""
    kept = {key: frame.T_map_keyframe for key, frame in state.map.keyframes.items()}
    gone = {key: se2.compose(submap.place(), T) for key, (submap, T) in state.map.retired.items()}
    by_light = {key: submap.place() for key, submap in state.map.light_anchors.items()}
    return {0: state.map.T_map_start} | by_light | gone | kept


def render_map(state: State, resolution: float) -> Grid:
    """Occupancy grid of all keyframes at their present poses, ``resolution`` metres per cell (`live_grid.at_once`)."""
    return live_grid.at_once(hanging(state.map.keyframes.values()), resolution)
