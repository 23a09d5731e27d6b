"""Acceptance of a relocalisation hypothesis: joins the detached submaps to the older map and moves the robot there."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Final

import numpy as np

from estimator.fusion import map_odom_filter
from estimator.mapping.keyframe import Keyframe
from estimator.mapping.loop_closure import join
from estimator.mapping.loop_verification import Found
from estimator.mapping.map_frame import alignment_covariance, relist, shift_map
from estimator.mapping.submap_graph import SubmapGraph
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.relocalisation.hypothesis_tracking import WATCH_M, Hypothesis, Seek, Watch
from estimator.relocalisation.owners import Owners
from estimator.result import LoopReason

SURPRISE: Final = 16.3
"""Squared Mahalanobis distance above which odometry across the break disagrees with the accepted pose."""


def land(state: Owners, one: Hypothesis, alone: bool) -> None:
    """Accept a hypothesis: join the detached part to the older map, and move the robot there.

    An unaligned map moves to the robot instead, if light has given the robot's pose. ``alone``: whether the lidar alone
    has decided.
    """
    graph, (frame, fit) = state.map.graph, one.held[-1]
    found = [(at, it) for at, it in (one.held[0], one.held[-1]) if at.submap.key in graph.submaps]
    if fit.key not in graph.submaps or not found:
        return
    T_map_keyframe = se2.compose(graph.submaps[fit.key].T_map_submap, fit.T_submap_keyframe)
    T_map_odom = se2.compose(T_map_keyframe, se2.inverse(frame.T_odom_keyframe))
    moved = se2.compose(T_map_odom, se2.inverse(state.pose.T_map_odom))
    stays = state.relocalisation.unaligned and state.pose.alignment is not None and state.pose.alignment.placed
    parts, was = graph.parts, state.pose.T_map_odom
    since, first = parts.detached_since, parts.detached
    shift_map(state.map, moved, since)
    if stays:
        state.pose.T_map_odom = T_map_odom  # restored below: it is no jump
    else:
        state.pose.move(T_map_odom, state.motion.T_odom_base)
    if first is not None:
        parts.trial = Watch(
            first=first,
            until_m=graph.way_m + WATCH_M,
            terrain=state.relocalisation.search.terrain,
            since=since,
            alone=alone,
            foreign_m=graph.way_m if state.relocalisation.unaligned else None,
        )
    parts.attach()
    state.relocalisation.search = Seek()
    for at, it in found[: 1 if one.held[0] is one.held[-1] else 2]:
        if it.key in graph.submaps:
            R = se2.rotation(-graph.submaps[it.key].T_map_submap[2])
            P = R @ it.P @ R.T
            close = Found(it.key, it.T_submap_keyframe, P, it.share, it.against, it.residual_m, np.zeros(3))
            join(graph, at, replace(close, reason=LoopReason.PLACED))
    agrees = bridge(graph, first)
    if isinstance(parts.trial, Watch):
        parts.trial.expected = agrees and state.relocalisation.dead_reckoning
    resettle(state, frame, fit.P, first)
    if stays:
        shift_map(state.map, se2.inverse(moved), 0)
        state.pose.T_map_odom = was
    relist(state.map, 0 if stays else since)


def bridge(graph: SubmapGraph, first: int | None) -> bool:
    """Add odometry across the break as an edge that may be false, where the accepted pose agrees; returns whether."""
    told, graph.parts.bridge = graph.parts.bridge, None
    if told is None or first not in graph.submaps or told[0] not in graph.submaps:
        return False
    key, T, P = told
    before, after = graph.submaps[key], graph.submaps[first]
    off = se2.between(T, se2.between(before.T_map_submap, after.T_map_submap))
    agrees = float(off @ invert3(P) @ off) < SURPRISE
    if agrees:
        graph.constraints.add(key, after.key, T, P, True)
    return agrees


def resettle(state: Owners, frame: Keyframe, P_map: Array, first: int | None) -> None:
    """Set the pose's covariance from the decisive match, the path since, and the map's alignment.

    ``first``: key of the first submap that is no part of that map.
    """
    graph = state.map.graph
    newest = graph.newest
    assert newest is not None
    T_keyframe_newest = se2.between(frame.T_odom_keyframe, newest.T_odom_submap)
    R = se2.rotation(-state.pose.T_map_odom[2])
    P = se2.carry(frame.T_map_keyframe, T_keyframe_newest, P_map)
    graph.marginal = R @ P @ R.T
    state.pose.P_anchor = graph.spread(state.pose.T_odom_anchor)
    alignment = state.pose.alignment
    if alignment is None:
        return
    from estimator.relocalisation.light_evidence import disputed, told

    if state.relocalisation.unaligned:  # map and robot are joined again: light moves both, as after a first start
        alignment.since, state.relocalisation.unaligned = 0, False
    elif alignment.placed or told(state.light, state.map.graph):  # the map frame is the survey frame
        map_odom_filter.hang_on_anchor(state.pose, state.motion)
        here, left = (
            state.pose.here(state.motion.T_odom_base),
            (state.relocalisation.T_left, state.relocalisation.P_left),
        )
        P_map_survey = alignment_covariance(graph.submaps.values(), here, first, left)
        alignment.P = alignment.P + R @ P_map_survey @ R.T  # at least the map's own covariance
        alignment.placed, alignment.proved, alignment.broken = True, True, False
        alignment.gap, alignment.odd_since, alignment.since = None, None, state.map.next_key
        map_odom_filter.place_given(alignment, True)
        alignment.way_start = -math.inf if state.light is None else state.light.filter.way_start
        alignment.unheard, alignment.t_match = (
            disputed(state.light, state.map.graph),
            state.motion.t_mono,
        )  # the lidar has just given the pose
