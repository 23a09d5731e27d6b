"""Map snapshot for storage: submaps, edges, keyframes, learned lamp gains and the last pose.

`estimator.stored_map` creates it from a state and a state from it. Operations longer than a fraction of a millisecond
(:meth:`MapImage.keyframes`, :func:`finished`) belong into the thread that writes it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np

from estimator.light_filter.survey import Lamp
from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Keyframe, Settled, settle
from estimator.numerics import se2
from estimator.numerics.arrays import Array

NOISE_M: Final = 0.01
"""Range noise of submaps that are finished before any residual is available, m."""

Gains = Mapping[int, tuple[Array, Array]]
"""By lamp ID: means and variances of (ln gain, tilt x, tilt y)."""


@dataclass(frozen=True, slots=True)
class Identity:
    """Identity of a map.

    Attributes:
        map_id: of its frame, drawn once; 0: none.
        name: of storey or building, free text.
        surveyed: whether its frame is the survey frame.
        survey: digest of that survey, empty without one.
        session: number of runs that have contributed.
    """

    map_id: int = 0
    name: str = ""
    surveyed: bool = False
    survey: str = ""
    session: int = 0


class Piece(NamedTuple):
    """A submap at the instant of the snapshot; fields as of `Submap`."""

    key: int
    first: int
    T_map_submap: Array
    T_odom_submap: Array
    way_m: float
    settled: Settled | None
    light: tuple[Array, Array] | None


class Hung(NamedTuple):
    """A keyframe, the key of its submap in the image, and its pose there."""

    frame: Keyframe
    submap: int
    T_submap_keyframe: Array


@dataclass(frozen=True, slots=True, eq=False)
class MapImage:
    """A map for storage.

    Attributes:
        identity: see `Identity`.
        submaps: finished ones, oldest first.
        constraints: edges between them.
        frames: keyframes; :meth:`keyframes` gives their poses.
        hung: by key of a submap that another has replaced: the other's key and T_other_submap.
        unsettled: submaps whose content is not finished yet; see :func:`finished`.
        noise_m: range noise of theirs.
        gains: learned gains of the lamps, empty without any.
        sensors: means and variances of the light filter's states 6 to 14 (state_vector.py), None without any.
        lamps: lamps known then, from the survey or from their own data.
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
        """Keyframes whose submap is in the image, with their poses."""
        keys = {piece.key for piece in self.submaps}
        for frame in self.frames:
            key = frame.submap.key
            T = se2.between(frame.submap.T_odom_submap, frame.T_odom_keyframe)
            if key in self.hung:
                key, T_hub = self.hung[key]
                T = se2.compose(T_hub, T)
            if key in keys:
                yield Hung(frame, key, T)


def finished(image: MapImage) -> MapImage:
    """The image with all submaps finished from their keyframes, and only edges between existing submaps.

    It takes some milliseconds for each of them, and so belongs into another thread.
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
