"""The map that the robot builds: keyframes, submap graph, live grid, and the settings of mapping."""

from __future__ import annotations

from dataclasses import dataclass, field

from estimator.mapping.keyframe import Keyframe, Square, Submap
from estimator.mapping.live_grid import LiveGrid
from estimator.mapping.loop_verification import LoopSettings
from estimator.mapping.map_parts import MapParts
from estimator.mapping.submap_graph import SubmapGraph
from estimator.numerics import se2
from estimator.numerics.arrays import Array


@dataclass(frozen=True, slots=True)
class MappingSettings:
    """When keyframes are laid, which are kept, and when a loop is one.

    Attributes:
        keyframe_m, keyframe_rad: a keyframe is laid after this much motion, or where fewer than ``keyframe_share`` of
            the beams still fit the map.
        keep: passes of one place, 0.4 m and 45 deg around, whose keyframes are kept.
        history: keep the pose of keyframes whose scan has been dropped; for replay, which needs them once at the end.
        localise: a restored map is only used: it never moves, and what is laid on top of it is dropped soon.
        live_m: metres per cell of a map that is kept up to date for display; 0: none is.
        loops: when a place counts as seen before; None: never.
    """

    keyframe_m: float = 0.25
    keyframe_rad: float = 0.26
    keyframe_share: float = 0.7
    keep: int = 2
    history: bool = False
    localise: bool = False
    live_m: float = 0.0
    loops: LoopSettings | None = field(default_factory=LoopSettings)


@dataclass(slots=True, eq=False)
class MapState:
    """The map.

    Attributes:
        settings: of mapping. graph: submaps, constraints between them, and their parts.
        keyframes: by ID, with their scans. places: their IDs by half metre square and eighth of a turn.
        retired: where history is kept, the submaps that dropped keyframes hang on, and their places there.
        light_anchors: where light alone held the pose, by ID.
        live: the map as cells, None: nobody asks for it. T_map_start: keyframe 0, where the robot was switched on.
        next_key: ID of the next keyframe. newest_step: `MatchMemory.steps`, rounded down, at the newest keyframe.
    """

    settings: MappingSettings
    graph: SubmapGraph
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    places: dict[Square, list[int]] = field(default_factory=dict)
    retired: dict[int, tuple[Submap, Array]] = field(default_factory=dict)
    light_anchors: dict[int, Submap] = field(default_factory=dict)
    live: LiveGrid | None = None
    T_map_start: Array = field(default_factory=se2.identity)
    next_key: int = 1
    newest_step: int = 0

    @property
    def parts(self) -> MapParts:
        """Which part of the graph is what."""
        return self.graph.parts

    def clear(self) -> None:
        """Forget the map and all jobs about it."""
        self.keyframes, self.places, self.retired, self.light_anchors = {}, {}, {}, {}
        self.graph = self.graph.renewed()
        if self.live is not None:
            self.live.clear()
