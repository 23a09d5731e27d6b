"""The method, as one readable step: predict -> lights -> virtual frame -> match -> fuse -> keyframe -> map."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from estimator.commands import obey
from estimator.fusion import map_odom_filter, motion_model, out_of_sequence, protection_level, time_offset
from estimator.fusion.laser_odometry import guide
from estimator.fusion.pose_update import alike_of, covariance, fuse, learn_alike, noise_of
from estimator.mapping import live_grid, loop_closure
from estimator.mapping.keyframe import hanging, unturned
from estimator.mapping.keyframe_selection import keyframe_due, lay_anchor, lay_keyframe, update_map, walk
from estimator.mapping.occupancy_grid import Grid
from estimator.measurements import (
    UNLIMITED,
    Answer,
    Array,
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
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation import kidnap_detection, relocalisation, unaligned_map
from estimator.result import MatchResult, Reason, StepResult
from estimator.scan_matching import matcher_choice, scan_matcher
from estimator.scan_matching.deskew import ScanPoints, oriented, points_of
from estimator.scan_matching.matcher_choice import First, Matcher, first_of
from estimator.scan_matching.scan_matcher import Asked, Prior, View
from estimator.scan_matching.scan_validation import in_time, nothing_of, refused
from estimator.state import Settings, State, new_state

__all__ = ["Settings", "State", "keyframe_poses", "new_state", "render_map", "step"]


FLOOR = np.diag((0.005**2, 0.005**2, 0.003**2))
"""Variance of what no filter knows of: stamps, sweep and mount of a moving robot."""


def step(state: State, records: Iterable[Record], limits: Limits, lap: Lap = no_lap) -> StepResult:
    """Take the records since the last step, in the order in which they were true (`in_turn`), and return the pose then.

    Never raises for what a sensor delivers: a scan that cannot be matched leaves the prediction and says why.
    """
    match: MatchResult | None = None
    keyframe = -1
    for record in in_turn(state, records):
        why = refused(state, record) if isinstance(record, Scan) else None
        if why is None:
            predict(state, record)
        if isinstance(record, SampleBlock | LightEpoch):
            see_lights(state, record)
            lay_anchor(state)
            lap("lights")
        if isinstance(record, Answer):
            close_loops(state, record)
            lap("map")
        if isinstance(record, Scan):
            why = why or passed_over(state, record, limits)
            if why is not None or not out_of_sequence.late(state, record):
                match, laid = see(state, record, limits, why, lap)
            else:
                ahead = out_of_sequence.go_back(state, record)
                match, laid = see(state, record, limits, why, lap)
                out_of_sequence.come_again(state, ahead)
            keyframe = max(keyframe, laid)
    lap("step")
    look_for_lamps(state, limits)
    lap("search")
    relocalisation.step_done(state)
    unaligned_map.step_done(state)
    return report(state, match, keyframe, limits)


def see(state: State, scan: Scan, limits: Limits, why: Reason | None, lap: Lap) -> tuple[MatchResult, int]:
    """Match a scan at the pose, take in what it says, and keep it where one is due; the match, and the ID or -1."""
    points = nothing_of(scan) if why else virtual_frame(state, scan)
    walk(state)
    match = match_scan(state, scan, points, limits, why)
    carried = kidnap_detection.raised(state, scan, points, match)
    fuse(state, match)
    guide(state, match)
    time_offset.on_match(state.lag, scan, match)
    if carried:
        kidnap_detection.look(state, scan, points, match)
    lap("match")
    if match.ok and kidnap_detection.waits(state):
        return match, -1
    if not (limits.update_map and limits.level < DegradationLevel.NO_MAP and keyframe_due(state, points, match)):
        return match, -1
    if match.ok:
        learn_alike(state, oriented(points, limits.points))
    keyframe = lay_keyframe(state, scan, points)
    update_map(state, scan, points)
    lap("map")
    return match, keyframe


def passed_over(state: State, scan: Scan, limits: Limits) -> Reason | None:
    """Why a scan is not matched in this step, if it is not: lights and odometry carry the pose, or it is too old."""
    if limits.level >= DegradationLevel.CARRIED:
        return Reason.PASSED_OVER
    return Reason.LATE if out_of_sequence.too_old(state, scan) else None


def order(record: Record) -> tuple[float, bool]:
    """Records go by the instant up to which they speak; a scan after whatever moved the robot until then."""
    end = record.t_end if isinstance(record, Scan | SampleBlock | LightEpoch | Odometry | Imu) else record.t_begin
    return end if in_time(end) else -math.inf, isinstance(record, Scan)


def in_turn(state: State, records: Iterable[Record]) -> list[Record]:
    """Records in the order in which they are taken; where matches tell `lights` the way, epochs after their scan.

    Until the scan has been matched nobody knows how the robot has moved since the one before, and light would be held
    against where the velocity has carried it: of a robot that is suddenly pushed and turned that is wrong by more than
    light is, and what light then says of the place turns its heading. No epoch waits where there is no scan, nor for a
    scan behind an order that came later than it; nor for the paper's matcher, which begins where light has it.
    """
    told = sorted(records, key=order)
    guided = state.light is not None and state.light.guided is not None and state.settings.matcher is Matcher.LINE
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
    """Bring the pose to the record's instant: by odometry, by gyro, else at constant velocity; obey a command."""
    if order(record)[0] == -math.inf:
        return  # at no time
    noise = state.settings.noise
    before = state.fused.T_odom_base, state.fused.P, state.fused.t_mono
    if state.light is not None:
        state.light.predict(record)
    match record:
        case Odometry():
            motion_model.on_odometry(state.fused, record, noise)
            time_offset.on_odometry(state.lag, record)
            kidnap_detection.on_odometry(state, record)
        case Imu():
            motion_model.on_imu(state.fused, record, noise)
        case Scan() | SampleBlock() | LightEpoch():
            motion_model.carry_to(state.fused, record.t_end, noise)
        case Command():
            obey(state, record)
            map_odom_filter.on_order(state, record)
            return  # RESET sets the odometry's covariance back: that is no motion
    map_odom_filter.on_motion(state, *before)


def see_lights(state: State, record: SampleBlock | LightEpoch) -> None:
    """Eq. 1-7: decode the block, if it is one, take its links into the `lights` filter, and its news into the pose.

    Without a photodiode in the setup the record is passed over.
    """
    if state.light is not None:
        map_odom_filter.on_lights(state, state.light.take(record))


def look_for_lamps(state: State, limits: Limits) -> None:
    """Go on looking for lamps that are not followed yet, as far as this cycle can afford."""
    if state.light is not None:
        state.light.look_on(limits.codes)


def virtual_frame(state: State, scan: Scan) -> ScanPoints:
    """Eq. 10-11: filter the beams (Q, L) and carry each from its own instant to the scan's end."""
    moved = se2.exp(state.fused.velocity * max(0.0, scan.t_end - scan.t_begin))
    return points_of(scan, moved, state.settings.far_m, state.settings.quality)


def match_scan(
    state: State, scan: Scan, points: ScanPoints, limits: Limits, refusal: Reason | None = None
) -> MatchResult:
    """Eq. 12-14: nearest neighbours on the distance axis, point-to-line, the prediction weighted in."""
    state.since_keyframe += 1
    T_pred, count = state.fused.T_odom_base, len(points.xy)
    asked: Asked | None = None
    if refusal is not None:
        result = scan_matcher.no_match(T_pred, count, refusal)
    elif state.local is None:
        result = scan_matcher.no_match(T_pred, count, Reason.NO_MAP)
    elif count < state.settings.matching.min_points:
        result = scan_matcher.no_match(T_pred, count, Reason.TOO_FEW_POINTS)
    else:
        beams = (unturned(scan.bearing_rad, points.turned_rad), scan.range_m, scan.beam)
        view = View(oriented(points, limits.points), scan.T_base_lidar, beams, noise_of(state, scan), alike_of(state))
        prior = Prior(T_pred, invert3(state.fused.P))
        asked = (view, state.local, prior, limits.icp_iterations, state.settings.matching)
        if state.settings.matcher is Matcher.LINE:
            result = scan_matcher.match(*asked)
        else:
            result, asked = matcher_choice.match(asked, light_first(state, prior), state.settings), None
    if state.journal is not None:
        state.journal(scan, points, asked, result)
    return result


def close_loops(state: State, answer: Answer) -> None:
    """Sect. 4.3: take in what a job has found, a loop or a corrected map; `T_odom_base` never hears of it."""
    loop_closure.take_answer(state, answer)


def light_first(state: State, prior: Prior) -> First:
    """T1 of Eq. 14 for the paper's matcher: from light, or the prediction where light tells nothing good."""
    assert state.local is not None
    lights = None if state.light is None else state.light.result
    return first_of(prior, state.local.newest, map_odom_filter.virtual(state), lights)


def report(state: State, match: MatchResult | None, keyframe: int, limits: Limits = UNLIMITED) -> StepResult:
    """The estimate after this step; jobs wait for one that has the time."""
    moving, P = state.fused, covariance(state)
    return StepResult(
        t_mono=moving.t_mono,
        T_odom_base=moving.T_odom_base,
        T_map_odom=state.T_map_odom,
        covariance=P + FLOOR,
        velocity=moving.velocity.copy(),
        known_axes=known_axes(state, match, P),
        match=match,
        keyframe=keyframe,
        loop=state.atlas.take_news(),
        anchor=state.anchor,
        T_anchor_base=se2.between(state.T_odom_anchor, moving.T_odom_base),
        jumps=state.jumps,
        lights=None if state.light is None else state.light.result,
        placed=state.absolute is not None and state.absolute.placed,
        gap=None if state.absolute is None else state.absolute.gap,
        places=relocalisation.places(state),
        apart=state.absolute is not None and state.absolute.apart,
        misplaced=misplaced(state),
        aside=state.atlas.aside is not None,
        let_go=state.let_go,
        lag=state.lag.told,
        jobs=state.atlas.take_jobs() if limits.level < DegradationLevel.NO_MAP else (),
        anew=state.anew,
        protection=protection_level.bound(state, P),
    )


def misplaced(state: State) -> bool:
    """Whether light receives what it cannot receive at the pose; see `light_evidence.misplaced`."""
    if state.light is None or state.absolute is None or not state.absolute.placed:
        return False
    from estimator.relocalisation import light_evidence  # costs nothing where there is no photodiode

    return light_evidence.misplaced(state, se2.compose(state.T_map_odom, state.fused.T_odom_base))


def known_axes(state: State, match: MatchResult | None, P: Array) -> Array:
    """The axes known in the map frame: in the survey by the pose's covariance ``P``, else those that the match shows.

    A corridor along x of the odom frame may run along y of the map.
    """
    if state.absolute is not None and state.absolute.placed:
        return np.asarray(P.diagonal() < map_odom_filter.KNOWN, dtype=np.float64)
    if match is None or not match.ok:
        return np.ones(3) if match is None else match.known_axes
    R = se2.rotation(state.T_map_odom[2])
    return scan_matcher.known_axes(R @ match.information @ R.T)


def keyframe_poses(state: State) -> dict[int, Array]:
    """``T_map_keyframe`` by ID as corrected so far, 0 being the start; those let go only where history is kept."""
    kept = {key: frame.T_map_keyframe for key, frame in state.keyframes.items()}
    gone = {key: se2.compose(submap.place(), T) for key, (submap, T) in state.retired.items()}
    lone = {key: submap.place() for key, submap in state.lone.items()}
    return {0: state.T_map_start} | lone | gone | kept


def render_map(state: State, resolution: float) -> Grid:
    """Occupancy grid of all keyframes at their present places, ``resolution`` metres per cell (`livemap.at_once`)."""
    return live_grid.at_once(hanging(state.keyframes.values()), resolution)
