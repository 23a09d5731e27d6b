"""Everything of a map that outlives the process: taken from a state within a cycle, made into a state at a later start.

:func:`image_of` only gathers references and copies places, so that it costs a cycle next to nothing; nothing that
happens to the state later changes what it gathered. Whatever takes longer (:meth:`MapImage.keyframes`,
:func:`finished`) is for the thread that writes it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from estimator.fusion.pose_update import covariance
from estimator.light_filter.survey import Lamp
from estimator.mapping import live_grid
from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Keyframe, Settled, Submap, square_of
from estimator.mapping.submap import settle
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.state import Settings, State, new_state

if TYPE_CHECKING:  # costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightsSetup

LONG_AGO_M: Final = 1000.0
"""Metres of way by which what is restored lies behind: it is no way just driven, and counts for loops."""
NOISE_M: Final = 0.01
"""Range noise of submaps that are finished before any residual has told it."""

Gains = Mapping[int, tuple[Array, Array]]
"""By lamp ID: means and variances of (ln gain, lean x, lean y)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """What tells one map from another.

    Attributes:
        map_id: of its frame, drawn once; 0: none. name: of floor or building, free text.
        surveyed: its frame is the light survey's. survey: digest of that survey, empty without one.
        session: how many runs have gone into it.
    """

    map_id: int = 0
    name: str = ""
    surveyed: bool = False
    survey: str = ""
    session: int = 0


class Piece(NamedTuple):
    """A submap as it was at that moment; fields as of `Submap`."""

    key: int
    first: int
    T_map_submap: Array
    T_odom_submap: Array
    way_m: float
    settled: Settled | None
    light: tuple[Array, Array] | None


class Hung(NamedTuple):
    """A keyframe, the key of the submap in the image that it hangs on, and its place there."""

    frame: Keyframe
    submap: int
    T_submap_keyframe: Array


@dataclass(frozen=True, slots=True, eq=False)
class MapImage:
    """A map at rest.

    Attributes:
        identity: which one. submaps: settled, oldest first. constraints: between them.
        frames: keyframes; where each lies is told by :meth:`keyframes`. hung: by key of a submap that another has taken
            the place of: the other's key and T_other_submap.
        unsettled: submaps whose content is not settled yet; see :func:`finished`. noise_m: range noise of theirs.
        gains, sensors: learned of the lamps, and means and variances of the `lights` filter's states 6 to 14
        (state_vector.py),
            empty where nothing was. lamps: known then, from the survey or by their own word.
        T_map_base, P: the last pose, with its covariance (map axes).
    """

    identity: Identity = field(default_factory=Identity)
    submaps: tuple[Piece, ...] = ()
    constraints: Constraints = field(default_factory=Constraints)
    frames: tuple[Keyframe, ...] = ()
    hung: Mapping[int, tuple[int, Array]] = field(default_factory=dict)
    unsettled: tuple[Piece, ...] = ()
    noise_m: float = NOISE_M
    gains: Gains = field(default_factory=dict)
    sensors: tuple[Array, Array] | None = None
    lamps: tuple[Lamp, ...] = ()
    T_map_base: Array = field(default_factory=se2.identity)
    P: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def keyframes(self) -> Iterator[Hung]:
        """Keyframes whose submap is in the image, with their places."""
        keys = {piece.key for piece in self.submaps}
        for frame in self.frames:
            key = frame.submap.key
            T = se2.between(frame.submap.T_odom_submap, frame.T_odom_keyframe)
            if key in self.hung:
                key, T_hub = self.hung[key]
                T = se2.compose(T_hub, T)
            if key in keys:
                yield Hung(frame, key, T)


def image_of(state: State, identity: Identity | None = None) -> MapImage:
    """The map of this moment, without what is adrift, or lies where only the laser has said and is still watched.

    While a stored map is put aside it is that one, as it was stored.

    At most a millisecond.
    """
    atlas, watch = state.atlas, state.atlas.watch
    whole = atlas if atlas.aside is None else atlas.aside
    frames = state.keyframes if atlas.aside is None else atlas.aside.frames
    joined = whole.constraints
    adrift = math.inf if atlas.adrift is None else atlas.adrift
    adrift = min(adrift, watch.first) if watch is not None and watch.alone else adrift
    pieces: list[Piece] = []
    hung: dict[int, tuple[int, Array]] = {}
    for submap in whole.submaps.values():
        if submap.key >= adrift:
            break
        pieces.append(_piece(submap))
        if len(submap.hung):
            hung |= {other.key: (submap.key, other.into[1]) for other in submap.hung if other.into is not None}
    tie, identity = state.absolute, identity or Identity()
    placed = tie is not None and tie.placed and atlas.unproved is None
    gains, sensors, lamps = _learned(state)
    return MapImage(
        identity=replace(identity, surveyed=identity.surveyed or placed),
        submaps=tuple(piece for piece in pieces if piece.settled is not None),
        constraints=Constraints(joined.between, joined.T, joined.information, joined.loop),
        frames=tuple(frames.values()),
        hung=hung,
        unsettled=tuple(piece for piece in pieces if piece.settled is None),
        noise_m=state.noise_m or NOISE_M,
        gains=gains,
        sensors=sensors,
        lamps=lamps,
        T_map_base=se2.compose(state.T_map_odom, state.fused.T_odom_base),
        P=covariance(state),
    )


def _piece(submap: Submap) -> Piece:
    T_map, T_odom = submap.T_map_submap, submap.T_odom_submap
    return Piece(submap.key, submap.first, T_map, T_odom, submap.way_m, submap.settled, submap.light)


def _learned(state: State) -> tuple[Gains, tuple[Array, Array] | None, tuple[Lamp, ...]]:
    """What the `lights` filter has learned of lamps and sensors."""
    if state.light is None:
        return {}, None, ()
    from estimator.light_filter.gain_memory import gains_known, sensors_known

    filtered = state.light.filter
    return gains_known(filtered), sensors_known(filtered), tuple(filtered.catalogue.by_id.values())


def finished(image: MapImage) -> MapImage:
    """The image with its unsettled submaps settled by what hangs on them, and only constraints between what is there.

    Takes some milliseconds for each of them, which is for another thread.
    """
    more = []
    for piece in image.unsettled:
        frames = [frame for frame in image.frames if frame.submap.key == piece.key]
        if frames:
            more.append(piece._replace(settled=settle(frames, piece.T_odom_submap, image.noise_m)))
    submaps = tuple(sorted((*image.submaps, *more), key=lambda piece: piece.key))
    joined = image.constraints
    there = np.isin(joined.between, [piece.key for piece in submaps]).all(axis=1)
    kept = Constraints(joined.between[there], joined.T[there], joined.information[there], joined.loop[there])
    return replace(image, submaps=submaps, constraints=kept, unsettled=())


def restored(image: MapImage, settings: Settings | None = None, lights: LightsSetup | None = None) -> State:
    """A robot that has just been switched on, with a map in which it does not know its place yet (`Atlas.adrift`).

    The last pose is where it is guessed to be. Nothing of the image is changed by what the state does later.

    Raises:
        ValueError: as of `new_state`.
    """
    state = new_state(settings, lights)
    image = finished(image)
    if state.light is not None:
        _recall(state, image)
    if not image.submaps:
        return state
    state.T_map_odom = state.T_map_start = image.T_map_base.copy()
    atlas, last = state.atlas, image.submaps[-1]
    for piece in image.submaps:
        way_m = piece.way_m - last.way_m - LONG_AGO_M
        T_map, T_odom = piece.T_map_submap.copy(), piece.T_odom_submap
        atlas.submaps[piece.key] = Submap(piece.key, piece.first, T_map, T_odom, way_m, piece.settled, piece.light)
    joined = image.constraints
    atlas.constraints = Constraints(joined.between, joined.T, joined.information, joined.loop)
    atlas.adrift = last.key + 1
    for hung in image.keyframes():
        submap = atlas.submaps[hung.submap]
        T_odom = se2.compose(submap.T_odom_submap, hung.T_submap_keyframe)
        frame = replace(hung.frame, submap=submap, T_odom_keyframe=T_odom)
        if frame.virtual is not None:
            submap.lamps |= frame.virtual.accepted
        state.keyframes[frame.key] = frame
        state.places.setdefault(square_of(frame.T_map_keyframe), []).append(frame.key)
    live_grid.begin(state)
    witnesses = (piece.settled.witness.key for piece in image.submaps if piece.settled is not None)
    state.next_key = 1 + max((*state.keyframes, *(piece.first for piece in image.submaps), *witnesses))
    atlas.since = atlas.kept = state.next_key
    atlas.held = state.settings.localise
    if state.absolute is not None:
        state.absolute.since = state.next_key
        atlas.askew, atlas.T_askew = image.P.copy(), image.T_map_base.copy()
        atlas.foreign = not (image.identity.surveyed or any(piece.light is not None for piece in image.submaps))
    return state


def _recall(state: State, image: MapImage) -> None:
    from estimator.light_filter.gain_memory import recall

    assert state.light is not None
    recall(state.light.filter, image.gains, image.sensors, image.lamps)
