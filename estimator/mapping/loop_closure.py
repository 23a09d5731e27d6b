"""Loop closure (Sect. 4.3): candidates, consensus of loops, graph update, and correction of the map.

Nothing here delays a cycle. Long work runs as a job: finish a submap, search for a loop, solve the graph. Its result is
a record of a later step. ``T_odom_base`` never changes. Without light the correction goes into ``T_map_odom``. With
light that has aligned the map, it moves the older submaps, and light moves the robot.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion
from estimator.job_queue import SEARCH, SOLVE, Owner, job_function
from estimator.mapping import graph_pose_prior, live_grid
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.mapping.loop_verification import Candidate, Found, LoopSettings, look, told_by_light
from estimator.mapping.map_frame import APART
from estimator.mapping.map_state import MapState
from estimator.mapping.pose_graph import UPPER, Graph, Solution, optimise
from estimator.mapping.relative_covariance import tied
from estimator.mapping.submap_graph import SubmapGraph, Waiting
from estimator.measurements import Answer
from estimator.numerics import se2
from estimator.numerics.arrays import Array, Ints
from estimator.numerics.symmetric3 import invert3
from estimator.result import SURPRISE, Loop, LoopReason

PHI: Final = 25.0
"""chi2 of three degrees of freedom at which a loop keeps a quarter of its weight: real maps deform more than noise."""

SETTLED, MOST = 1e-5, 100
TOGETHER: Final = 60
"""Most keyframes between two loops of one consensus."""

TURNED: Final = 1.05
"""Rotation (rad) after which a lidar with half the horizon sees another part of the surroundings."""

TREMBLE: Final = np.diag((0.005**2, 0.005**2, 0.003**2))
"""Covariance of the variation of a map correction."""

AS_ONE: Final = 1e-6
"""Rounding (m, rad) of submaps that moved together."""


def take_answer(map_: MapState, pose: MapPose, motion: Motion, answer: Answer) -> None:
    """Apply a job result, and continue with the graph and the live grid."""
    map_.graph.jobs.answer(answer)
    solve_graph(map_, pose, motion)
    live_grid.go_on(map_.live, map_.graph)


def add_keyframe(map_: MapState, pose: MapPose, frame: Keyframe, odometry: tuple[Array, float, bool]) -> None:
    """Add a new keyframe to the graph and search for a loop where one is due.

    ``odometry``: covariance since the previous keyframe, range noise, and whether the local map was lost, see
    `SubmapGraph.add`.
    """
    graph, loops = map_.graph, map_.settings.loops
    before, frames = graph.newest, graph.frames
    graph.add(frame, *odometry)
    live_grid.follow(map_.live, graph, before, frames)
    if loops is not None and not graph.jobs.busy(Owner.LOOP_SEARCH) and graph.since_look >= loops.every:
        look_back(graph, pose, loops, frame)


def look_back(graph: SubmapGraph, pose: MapPose, settings: LoopSettings, frame: Keyframe) -> None:
    """Queue the search of a keyframe in the submaps that may contain it."""
    asked = candidates(graph, pose, settings, frame)
    if not asked:
        return
    graph.since_look = 0
    then = partial(take_loops, graph, settings, frame)
    graph.jobs.ask(SEARCH, partial(look, frame, asked, settings), then, owner=Owner.LOOP_SEARCH)


@job_function
def take_loops(graph: SubmapGraph, settings: LoopSettings, frame: Keyframe, payload: object) -> None:
    """Apply the result of a search."""
    assert isinstance(payload, tuple)
    for found in payload:
        found_again(graph, settings, frame, found)


def candidates(graph: SubmapGraph, pose: MapPose, settings: LoopSettings, frame: Keyframe) -> tuple[Candidate, ...]:
    """The nearest submaps that may contain the keyframe, without those of the path just driven."""
    T = frame.T_map_keyframe
    here_x, here_y, _ = T.tolist()
    near, left_before, most_m = [], graph.way_m - settings.recent_m, settings.most_m
    vaguest = placed_trace(pose)  # upper bound for every submap, so most are excluded without their own covariance
    for submap in graph.of_part(frame.submap):
        settled = submap.settled
        joined = submap.key >= graph.broken  # by matches, without a gap
        if settled is None or (joined and submap.way_m >= left_before):
            continue
        x, y, _ = submap.T_map_submap.tolist()  # most of a large map ends here, so it is done by hand
        u, v, _ = settled.witness.T_odom_keyframe.tolist()
        if math.hypot(x - here_x, y - here_y) >= most_m + math.hypot(u, v):
            continue
        middle = se2.compose(submap.T_map_submap, settled.witness.T_odom_keyframe)
        x, y, yaw = se2.between(middle, T).tolist()
        far = math.hypot(x, y)
        if far >= min(settings.most_m, settings.reach_m + 3.0 * math.sqrt(vaguest)):
            continue
        if far >= settings.reach_m:
            P = certainty(graph, pose, submap, frame)
            if far >= settings.reach_m + 3.0 * math.sqrt(float(P[0, 0] + P[1, 1])):
                continue
        # with the opposite heading a lidar sees little of the same
        near.append((far + settings.turned_m * (1.0 - math.cos(yaw)), submap.key, submap, settled))
    near.sort(key=lambda one: one[:2])
    made = []
    for _, key, submap, settled in near[: settings.candidates]:
        R, P = se2.rotation(-submap.T_map_submap[2]), certainty(graph, pose, submap, frame)
        said = told_by_light(frame, submap, settings)
        made.append(Candidate(key, settled, se2.between(submap.T_map_submap, T), R @ P @ R.T, said))
    return tuple(made)


def certainty(graph: SubmapGraph, pose: MapPose, submap: Submap, frame: Keyframe) -> Array:
    """Covariance (map axes) of the newest keyframe relative to a submap: by the path, by loops, or by light."""
    P = graph.apart(submap, frame.T_odom_keyframe)
    alignment = pose.alignment
    if alignment is not None and np.trace(P) > placed_trace(pose):
        P = alignment.P
    return turned(pose, P)


def placed_trace(pose: MapPose) -> float:
    """Trace of the covariance (any axes) of the pose by light; infinite where light has not aligned the map."""
    alignment = pose.alignment
    return float(np.trace(alignment.P)) if alignment is not None and alignment.placed else math.inf


def lit(pose: MapPose) -> bool:
    """Whether light has aligned the map, and so determines the pose in it."""
    return pose.alignment is not None and pose.alignment.placed


def turned(pose: MapPose, P_odom: Array) -> Array:
    """A covariance of the odom frame in the axes of the map."""
    R = se2.rotation(pose.T_map_odom[2])
    return np.asarray(R @ P_odom @ R.T)


def found_again(graph: SubmapGraph, settings: LoopSettings, frame: Keyframe, found: Found) -> None:
    """Accept a loop, or let it wait for others that agree where its correction is large."""
    if found.key not in graph.submaps or graph.submaps.get(frame.submap.key) is not frame.submap:
        return  # removed meanwhile, and its key may have been reused
    if not found.alone:  # the surroundings repeat here: earlier agreement may have been at the other position
        graph.waiting = []
        return
    one = Waiting(found, frame, se2.compose(found.T_submap_keyframe, se2.inverse(frame.T_odom_keyframe)))
    if (
        not within(found.moved, settings, 1.0) and found.reason is not LoopReason.LIT
    ):  # for that reason light has confirmed it
        friends = supporters(graph, settings, one)
        far = min(math.hypot(*found.moved[:2]), settings.most_m)
        if not friends or max(apart(one, other) for other in friends) < far:
            graph.waiting = [*graph.waiting[-TOGETHER:], one]
            return
        graph.waiting = [other for other in graph.waiting if other not in friends]
        for other in friends:
            join(graph, other.frame, replace(other.found, reason=LoopReason.SUPPORTED))
        found = replace(found, reason=LoopReason.SUPPORTED)
    graph.waiting = [  # the others are refuted, or too old
        other
        for other in graph.waiting
        if comparable(graph, one, other) and within(off(graph, one, other), settings, 1.0)
    ]
    join(graph, frame, found)


def supporters(graph: SubmapGraph, settings: LoopSettings, one: Waiting) -> list[Waiting]:
    """The loops that agree with this one, newest first, back to the first that contradicts it."""
    friends: list[Waiting] = []
    for other in reversed(graph.waiting):
        if not comparable(graph, one, other):
            continue
        if not within(off(graph, one, other), settings, 1.0):
            break
        if within(off(graph, one, other), settings, 0.5):
            friends.append(other)
    return friends


def apart(one: Waiting, other: Waiting) -> float:
    """Distance (m) of two keyframes; infinite where the rotation has shown the robot another side.

    In repeating surroundings a position off by one period fits too, while the true one is not mapped. That ends when
    the path is as long as the loop's correction. The true position has then been reached and mapped, and a match finds
    it there.
    """
    x, y, yaw = se2.between(other.frame.T_odom_keyframe, one.frame.T_odom_keyframe).tolist()
    return math.inf if abs(yaw) > TURNED else math.hypot(x, y)


def comparable(graph: SubmapGraph, one: Waiting, other: Waiting) -> bool:
    """Whether two loops concern the same segment of the path, in submaps that still exist."""
    laid = other.frame.submap
    there = one.found.key in graph.submaps and other.found.key in graph.submaps and graph.submaps.get(laid.key) is laid
    return there and one.frame.key - other.frame.key <= TOGETHER


def off(graph: SubmapGraph, one: Waiting, other: Waiting) -> Array:
    """Difference (x, y, yaw) of a keyframe's pose by its own loop and by another one."""
    a, b = graph.submaps[one.found.key], graph.submaps[other.found.key]
    T_b_a = se2.between(b.T_map_submap, a.T_map_submap)
    there = se2.compose(other.T_found_odom, one.frame.T_odom_keyframe)
    return se2.between(there, se2.compose(T_b_a, one.found.T_submap_keyframe))


def within(moved: Array, settings: LoopSettings, share: float) -> bool:
    """Whether a correction is smaller than this share of the limit for consensus."""
    x, y, yaw = moved.tolist()
    return math.hypot(x, y) <= share * settings.supported_m and abs(yaw) <= share * settings.supported_rad


def join(graph: SubmapGraph, frame: Keyframe, found: Found) -> None:
    """Add a loop to the graph: an edge from the matched submap to the keyframe's submap."""
    T_keyframe_submap = se2.between(frame.T_odom_keyframe, frame.submap.T_odom_submap)
    R, A = se2.rotation(-found.T_submap_keyframe[2]), se2.adjoint(se2.inverse(T_keyframe_submap))
    P = A @ R @ found.P @ R.T @ A.T
    graph.constraints.add(found.key, frame.submap.key, se2.compose(found.T_submap_keyframe, T_keyframe_submap), P, True)
    graph.closures += 1
    first = graph.submaps[found.key].first
    graph.news = Loop(graph.closures, frame.key, first, found.residual_m, found.reason)
    graph.stale = True


def solve_graph(map_: MapState, pose: MapPose, motion: Motion) -> None:
    """Queue the solution of the graph, if it has changed and is not being solved."""
    graph = map_.graph
    newest, detached = graph.newest, graph.parts.detached
    begun = newest is not None and (detached is None or newest.key >= detached)
    if graph.jobs.busy(Owner.SOLUTION) or not graph.stale or not begun:
        return
    graph.stale, submaps = False, tuple(graph.submaps.values())
    problem = graph_of(graph, pose, submaps)
    then = partial(take_solution, map_, pose, motion, submaps, problem.poses)
    graph.jobs.ask(SOLVE, partial(solved, problem), then, owner=Owner.SOLUTION)


@job_function
def take_solution(
    map_: MapState, pose: MapPose, motion: Motion, submaps: tuple[Submap, ...], before: Array, payload: object
) -> None:
    """Apply a solution; ``before``: poses of the submaps, (n, 3), when it was queued."""
    assert isinstance(payload, tuple)
    graph, (before, solution, ties) = map_.graph, along(submaps, before, *payload[:2])
    if correct(map_, pose, motion, submaps, (before, solution)):
        if payload[2] is not None and lit(pose) and submaps[-1] is graph.newest:
            graph_pose_prior.take(map_, pose, motion, payload[2])
        R = se2.rotation(-pose.T_map_odom[2])
        graph.tied = submaps[-1]
        turned = R @ ties @ R.T  # all at once: one by one they made this cycle 2 ms longer with 1000 submaps
        graph.ties = dict(zip([submap.key for submap in submaps], turned, strict=True))


@job_function
def solved(graph: Graph) -> tuple[Solution, Array, graph_pose_prior.Said | None]:
    """The graph's solution, relative covariances of the newest submap (`tied`), and the map's prior of its pose."""
    last = len(graph.poses) - 1
    solution = optimise(graph, MOST, SETTLED, PHI, covariance_of=last)
    ties = tied(graph, solution.poses, solution.trust, last)
    return solution, ties, graph_pose_prior.said(graph, solution, ties, (MOST, SETTLED, PHI))


def graph_of(graph: SubmapGraph, pose: MapPose, submaps: tuple[Submap, ...]) -> Graph:
    """The submaps as a graph: edges by odometry and loops, and absolute priors by light."""
    joined = graph.constraints
    keys = np.array([submap.key for submap in submaps])
    poses = np.array([submap.T_map_submap for submap in submaps])
    edges = np.searchsorted(keys, joined.between)
    if graph.parts.fixed:
        held = np.array([graph.is_held(submap) for submap in submaps])
        return Graph(poses, edges, joined.T, joined.information, joined.loop, held=held)
    if not lit(pose):
        return Graph(poses, edges, joined.T, joined.information, joined.loop)
    anchored, at, certainty = anchors(graph, pose, keys)
    return Graph(poses, edges, joined.T, joined.information, joined.loop, anchored, at, certainty)


def anchors(graph: SubmapGraph, pose: MapPose, keys: Ints) -> tuple[Ints, Array, Array]:
    """Absolute priors: the light solutions at earlier submaps, and the alignment at the newest."""
    newest, alignment = graph.newest, pose.alignment
    assert newest is not None
    assert alignment is not None
    told = [(submap.key, *submap.light) for submap in graph.submaps.values() if submap.light and submap is not newest]
    told = [(key, T, APART * P) for key, T, P in told]
    told.append((newest.key, newest.T_map_submap, turned(pose, alignment.P)))
    anchored, at = np.searchsorted(keys, [key for key, _, _ in told]), np.array([T for _, T, _ in told])
    return anchored, at, information(at, np.array([P for _, _, P in told]))


def information(at: Array, P_map: Array) -> Array:
    """Information (upper triangles, (n, 6)) of poses (n, 3) in their own axes, from covariances (n, 3, 3) in map axes.

    It is vectorised because it runs in a cycle; one by one it took 2 ms of it with a hundred poses.
    """
    R, c, s = np.zeros(P_map.shape), np.cos(at[:, 2]), np.sin(at[:, 2])
    R[:, 0, 0] = R[:, 1, 1] = c
    R[:, 0, 1], R[:, 1, 0], R[:, 2, 2] = s, -s, 1.0
    H = np.array([invert3(P) for P in R @ P_map @ R.transpose(0, 2, 1)])
    rows, columns = np.array(UPPER).T
    return np.ascontiguousarray(H[:, rows, columns])


def along(submaps: tuple[Submap, ...], before: Array, solution: Solution, ties: Array) -> tuple[Array, Solution, Array]:
    """Transform a solution where the whole map has moved as one body since, as while light still aligns it.

    Such a map may move with every epoch. If its solutions were rejected for that, no loop would ever correct it.

    ``before`` (n, 3) are the submap poses at the start of the solution; ``ties`` (n, 3, 3) came with it. Returns these,
    the solution and the ties as if the map had moved before; unchanged where it did not move as one.
    """
    now = np.array([submap.T_map_submap for submap in submaps])
    there = np.array([submap.into is None for submap in submaps[:-1]], np.bool_)
    if not there.any() or np.array_equal(now, before):
        return before, solution, ties
    k = int(np.argmax(there))
    moved = se2.compose(now[k], se2.inverse(before[k]))
    places = se2.compose_all(moved, before)
    off = places - now
    off[:, 2] = np.remainder(off[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    near = np.abs(off).max(axis=1) < AS_ONE
    if not near[:-1][there].all():
        return before, solution, ties
    places[near] = now[near]
    R = se2.rotation(moved[2])
    P = R @ solution.covariance @ R.T
    solution = replace(solution, poses=se2.compose_all(moved, solution.poses), covariance=P)
    return places, solution, np.asarray(R @ ties @ R.T)


def correct(
    map_: MapState, pose: MapPose, motion: Motion, submaps: tuple[Submap, ...], result: tuple[Array, Solution]
) -> bool:
    """Move the submaps to their solved poses, and the robot with the newest one unless light gives its pose.

    ``result``: poses (n, 3) of the submaps at the start of the solution, and the solution.

    Returns whether it did. If submaps have moved or been removed meanwhile, the solution is rejected, and the graph is
    solved again.
    """
    graph, (before, solution) = map_.graph, result
    newest = graph.newest
    held, last = lit(pose) and not graph.parts.fixed, submaps[-1]
    counts = np.array([submap.into is None and not (held and submap is last) for submap in submaps])
    known = graph.submaps.get
    there = all(submap.into is not None or known(submap.key) is submap for submap in submaps)
    same = there and np.array_equal(np.array([submap.T_map_submap for submap in submaps])[counts], before[counts])
    if newest is None or not same or not np.isfinite(solution.poses).all():
        graph.stale |= not same
        return False
    moved = se2.compose(solution.poses[-1], se2.inverse(last.T_map_submap))
    first = se2.compose(solution.poses[0], se2.inverse(submaps[0].T_map_submap))
    if map_.live is not None:
        map_.live.due = True
    for submap, T in zip(submaps, solution.poses, strict=True):
        if not (held and submap is last):
            submap.T_map_submap = T
    map_.T_map_start = se2.compose(first, map_.T_map_start)
    if held:
        return True
    for submap in graph.submaps.values():
        if submap.key > last.key:
            submap.T_map_submap = se2.compose(moved, submap.T_map_submap)
    before_map = pose.T_map_odom
    pose.move(se2.compose(newest.T_map_submap, se2.inverse(newest.T_odom_submap)), motion.T_odom_base)
    if newest is last:
        R = se2.rotation(-pose.T_map_odom[2])
        graph.marginal = R @ solution.covariance @ R.T
        pose.P_anchor = surer(pose, graph.spread(pose.T_odom_anchor), before_map)
        if pose.alignment is not None and graph.parts.fixed:
            map_odom_filter.hang_on_anchor(pose, motion)
    else:
        graph.stale = True  # the newest one's covariance is not known yet
    return True


def surer(pose: MapPose, P_graph: Array, T_map_odom_before: Array) -> Array:
    """Covariance (odom axes) of the newest keyframe's pose in the map after a correction by the graph.

    The graph allows for the largest deformation of real maps, so that its loops are accepted. A loop does not increase
    the covariance that matching had, unless the correction exceeds it.
    """
    T_anchor = pose.T_odom_anchor
    off = se2.compose(pose.T_map_odom, T_anchor) - se2.compose(T_map_odom_before, T_anchor)
    off[2] = se2.wrap(float(off[2]))
    off = se2.rotation(-pose.T_map_odom[2]) @ off
    P_way = pose.P_anchor
    fits = float(off @ invert3(P_way + TREMBLE) @ off) <= SURPRISE
    return P_way if fits and np.trace(P_way) < np.trace(P_graph) else P_graph
