"""Which part of the submap graph is what: restored, detached, on trial, or set aside."""

from __future__ import annotations

from dataclasses import dataclass

from estimator.mapping.constraints import Constraints
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.numerics.arrays import Array


@dataclass(slots=True, eq=False, kw_only=True)
class Trial:
    """Submaps laid since the robot was found in the map, while that place is being confirmed.

    Attributes:
        first: key of the first submap that is no part of the map the robot was found in. since: ID of the first
            keyframe of that part. alone: the laser alone has decided. foreign_m: way driven when a map in a frame of
            its own began to be searched, m; None: the map lies in the survey's frame, or there is no light.
    """

    first: int
    since: int = 0
    alone: bool = False
    foreign_m: float | None = None


@dataclass(slots=True, eq=False, kw_only=True)
class SetAside:
    """A stored map in a frame of its own in which the robot has not been found yet.

    Attributes:
        submaps, constraints: as of `SubmapGraph`. frames: its keyframes by ID. session_start: as of `MapParts`, for
            when it is found. first: key of the first submap that is no part of it; since: ID of the first such
            keyframe. begun_m: way driven when it was first set aside, m.
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
        detached: key of the first submap whose place in the map is not known, None where the robot's place is: it and
            all later ones are a part of the graph that nothing joins to the older one. detached_since: ID of their
            first keyframe, 0 where nothing is detached. bridge: the way across that break, if there was one: key of
            the submap before, T_submap_detached and its covariance in the latter's axes.
        session_start: ID of this session's first keyframe where the map is a restored one, else 0. fixed: that map is
            only used, see `MappingSettings.localise`.
        trial: None: no place is being confirmed. aside: None: no map is set aside.
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
        """Key of the first submap that is no part of the stored map, while that is undecided; None: it is decided."""
        if self.aside is not None:
            return self.aside.first
        if self.trial is not None and self.trial.foreign_m is not None:
            return self.trial.first
        return self.detached

    def attach(self) -> None:
        """The robot's place is known: nothing is detached."""
        self.detached, self.detached_since = None, 0
