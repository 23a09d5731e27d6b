"""Map snapshot of a running state, taken within a cycle, and a new state with a stored map.

:func:`image_of` only collects references and copies poses, so that it costs a cycle next to nothing. Later changes of
the state do not affect the snapshot.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Final

from estimator.light_filter.survey import Lamp
from estimator.mapping import live_grid
from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Submap, square_of
from estimator.mapping.map_snapshot import NOISE_M, Gains, Identity, MapImage, Piece, finished
from estimator.mapping.map_state import MapState
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.state import Settings, State, new_state

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel, LightsSetup

LONG_AGO_M: Final = 1000.0
"""Path length (m) before the start at which restored submaps lie, so that they are not the path just driven."""


def image_of(state: State, identity: Identity | None = None) -> MapImage:
    """Snapshot of the present map, without detached submaps and those on trial that the lidar alone has found.

    Beside an unaligned map it is that map, as it was stored.

    It takes at most a millisecond.
    """
    graph, parts = state.map.graph, state.map.parts
    whole = graph if parts.aside is None else parts.aside
    frames = state.map.keyframes if parts.aside is None else parts.aside.frames
    joined = whole.constraints
    first = math.inf if parts.detached is None else parts.detached
    first = min(first, parts.trial.first) if parts.trial is not None and parts.trial.alone else first
    pieces: list[Piece] = []
    hung: dict[int, tuple[int, Array]] = {}
    for submap in whole.submaps.values():
        if submap.key >= first:
            break
        pieces.append(_piece(submap))
        if len(submap.hung):
            hung |= {other.key: (submap.key, other.into[1]) for other in submap.hung if other.into is not None}
    alignment, identity = state.pose.alignment, identity or Identity()
    placed = alignment is not None and alignment.placed and parts.unproved is None
    gains, sensors, lamps = _learned(state.light)
    T_odom_base = state.motion.T_odom_base
    return MapImage(
        identity=replace(identity, surveyed=identity.surveyed or placed),
        submaps=tuple(piece for piece in pieces if piece.settled is not None),
        constraints=Constraints(joined.between, joined.T, joined.information, joined.loop),
        frames=tuple(frames.values()),
        hung=hung,
        unsettled=tuple(piece for piece in pieces if piece.settled is None),
        noise_m=state.matching.noise_m or NOISE_M,
        gains=gains,
        sensors=sensors,
        lamps=lamps,
        T_map_base=state.pose.here(T_odom_base),
        P=state.pose.covariance(T_odom_base, state.motion.P),
    )


def _piece(submap: Submap) -> Piece:
    T_map, T_odom = submap.T_map_submap, submap.T_odom_submap
    return Piece(submap.key, submap.first, T_map, T_odom, submap.way_m, submap.settled, submap.light)


def _learned(light: LightChannel | None) -> tuple[Gains, tuple[Array, Array] | None, tuple[Lamp, ...]]:
    """Gains of the lamps, sensor states and lamps that the light filter has learned."""
    if light is None:
        return {}, None, ()
    from estimator.light_filter.gain_memory import gains_known, sensors_known

    return gains_known(light.filter), sensors_known(light.filter), tuple(light.filter.catalogue.by_id.values())


def restored(image: MapImage, settings: Settings | None = None, lights: LightsSetup | None = None) -> State:
    """State at a start, with a map in which the robot's pose is not known yet (`MapParts.detached`).

    The last pose is the unconfirmed pose. Later changes of the state do not affect the image.

    Raises:
        ValueError: as of `new_state`.
    """
    state = new_state(settings, lights)
    image = finished(image)
    if state.light is not None:
        from estimator.light_filter.gain_memory import recall

        recall(state.light.filter, image.gains, image.sensors, image.lamps)
    if not image.submaps:
        return state
    state.pose.T_map_odom = state.map.T_map_start = image.T_map_base.copy()
    fill(state.map, image)
    alignment, relocalisation = state.pose.alignment, state.relocalisation
    if alignment is not None:
        alignment.since = state.map.next_key
        relocalisation.P_left, relocalisation.T_left = image.P.copy(), image.T_map_base.copy()
        lit = any(piece.light is not None for piece in image.submaps)
        relocalisation.unaligned = not (image.identity.surveyed or lit)
    return state


def fill(map_: MapState, image: MapImage) -> None:
    """Fill an empty map with an image that contains submaps."""
    graph, parts, last = map_.graph, map_.parts, image.submaps[-1]
    for piece in image.submaps:
        way_m = piece.way_m - last.way_m - LONG_AGO_M
        T_map, T_odom = piece.T_map_submap.copy(), piece.T_odom_submap
        graph.submaps[piece.key] = Submap(piece.key, piece.first, T_map, T_odom, way_m, piece.settled, piece.light)
    joined = image.constraints
    graph.constraints = Constraints(joined.between, joined.T, joined.information, joined.loop)
    parts.detached = last.key + 1
    for hung in image.keyframes():
        submap = graph.submaps[hung.submap]
        T_odom = se2.compose(submap.T_odom_submap, hung.T_submap_keyframe)
        frame = replace(hung.frame, submap=submap, T_odom_keyframe=T_odom)
        if frame.virtual is not None:
            submap.lamps |= frame.virtual.accepted
        map_.keyframes[frame.key] = frame
        map_.places.setdefault(square_of(frame.T_map_keyframe), []).append(frame.key)
    live_grid.begin(map_.live, map_.keyframes.values())
    witnesses = (piece.settled.witness.key for piece in image.submaps if piece.settled is not None)
    map_.next_key = 1 + max((*map_.keyframes, *(piece.first for piece in image.submaps), *witnesses))
    parts.detached_since = parts.session_start = map_.next_key
    parts.fixed = map_.settings.localise
