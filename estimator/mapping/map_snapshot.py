"""A map at rest: everything of a map that outlives the process.

Taking it from a state and making a state with it is in `estimator.stored_map`. Whatever takes longer than a fraction
of a millisecond (:meth:`MapImage.keyframes`, :func:`finished`) is for the thread that writes it.
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
