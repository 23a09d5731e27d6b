"""Map state and mapping settings: keyframes, submap graph and live grid."""

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
    """When keyframes are created, which are kept, and when a loop is accepted.

    Attributes:
        keyframe_m, keyframe_rad: distance and rotation between keyframes.
        keyframe_share: inlier share below which a keyframe is created earlier.
        keep: number of passes of one position, 0.4 m and 45 deg around, whose keyframes are kept.
        history: keep the pose of keyframes whose scan has been dropped; a replay needs them once at the end.
        localise: a restored map is only used: it never moves, and submaps on top of it are dropped soon.
        live_m: metres per cell of the live grid for display; 0: there is none.
        loops: settings of loop closure; None: no loops.
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
        settings: of mapping.
        graph: submaps, edges between them, and their parts.
        keyframes: by ID, with their scans.
        places: their IDs by half metre square and eighth of a turn.
        retired: where history is kept, the submaps of dropped keyframes, and their poses there.
        light_anchors: anchors where light alone gave the pose, by ID.
        live: the map as cells, None without a display.
        T_map_start: keyframe 0, the pose at the start.
        next_key: ID of the next keyframe.
        newest_step: `MatchMemory.steps`, rounded down, at the newest keyframe.
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
        """Parts of the graph."""
        return self.graph.parts

    def clear(self) -> None:
        """Clear the map and all jobs about it."""
        self.keyframes, self.places, self.retired, self.light_anchors = {}, {}, {}, {}
        self.graph = self.graph.renewed()
        if self.live is not None:
            self.live.clear()
