"""Parts of the submap graph: restored from a stored map, detached, on trial after relocalisation, or unaligned."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.numerics.arrays import Array


@dataclass(slots=True, eq=False, kw_only=True)
class Trial:
    """Submaps created since the robot was found in the map, until that pose is confirmed.

    Attributes:
        first: key of the first submap that is no part of the map in which the robot was found.
        since: ID of the first keyframe of that part.
        alone: whether the lidar alone has decided.
        foreign_m: path length at which the search in a map with its own frame began, m. None: the map lies in the
            survey frame, or there is no light.
    """

    first: int
    since: int = 0
    alone: bool = False
    foreign_m: float | None = None


@dataclass(slots=True, eq=False, kw_only=True)
class SetAside:
    """An unaligned map: a stored map with its own frame, in which the robot has not been found yet.

    Attributes:
        submaps, constraints: as of `SubmapGraph`.
        frames: its keyframes by ID.
        session_start: as of `MapParts`, for when the robot is found.
        first: key of the first submap that is no part of it.
        since: ID of the first such keyframe.
        begun_m: path length at which it first became unaligned, m.
    """

    submaps: dict[int, Submap]
    constraints: Constraints
    frames: dict[int, Keyframe]
    session_start: int
    first: int
    since: int
    begun_m: float


@dataclass(slots=True, eq=False)
class MapParts:
    """The parts that the submaps belong to.

    Attributes:
        detached: key of the first submap of unknown pose in the map, None where the robot's pose is known. No edge
            joins it and all later ones to the older graph.
        detached_since: ID of their first keyframe, 0 where nothing is detached.
        bridge: odometry across that break, if there was any: key of the submap before, T_submap_detached and its
            covariance in the latter's axes.
        session_start: ID of this session's first keyframe where the map is a restored one, else 0.
        fixed: whether that map is only used, see `MappingSettings.localise`.
        trial: None: no pose is being confirmed.
        aside: None: there is no unaligned map.
    """

    detached: int | None = None
    detached_since: int = 0
    bridge: tuple[int, Array, Array] | None = None
    session_start: int = 0
    fixed: bool = False
    trial: Trial | None = None
    aside: SetAside | None = None

    @property
    def unproved(self) -> int | None:
        """Key of the first submap outside the stored map while that is undecided; None: it is decided."""
        if self.aside is not None:
            return self.aside.first
        if self.trial is not None and self.trial.foreign_m is not None:
            return self.trial.first
        return self.detached

    def attach(self) -> None:
        """End the detachment, when the robot's pose is known."""
        self.detached, self.detached_since = None, 0
