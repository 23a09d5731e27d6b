"""What the estimator knows between two steps, and its few settings."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from estimator.fusion.map_odom_history import Frozen
from estimator.fusion.motion_model import Motion, MotionNoise
from estimator.fusion.time_offset import TimeLag
from estimator.mapping.keyframe import Keyframe, Submap
from estimator.mapping.live_grid import LiveMap
from estimator.mapping.loop_verification import LoopSettings
from estimator.mapping.submap_graph import Atlas
from estimator.measurements import Scan
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.relocalisation.hypothesis_tracking import Suspicion
from estimator.result import MatchResult
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.local_map import LocalMap, MapSettings
from estimator.scan_matching.matcher_choice import Matcher, Weight, load
from estimator.scan_matching.scan_matcher import Asked, MatchSettings

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.fusion.map_odom_filter import Absolute
    from estimator.light_filter.light_channel import Light, LightsSetup

Place = tuple[int, int, int]

Journal = Callable[[Scan, ScanPoints, Asked | None, MatchResult], None]
"""Takes a scan, its points, what the matcher was asked with (None where it was not asked) and what came of it. It may
keep all of them: none is changed later. It must not change anything."""


@dataclass(frozen=True, slots=True)
class Settings:
    """One set for every robot and lidar; what differs between devices comes with each scan.

    Attributes:
        far_m: L of the paper's quality filter; ranges beyond it are not used.
        quality: Q of the filter; a beam whose intensity is lower is not used (only where a scan has intensities).
        keyframe_m, keyframe_rad: a keyframe is laid after this much motion, or where fewer than ``keyframe_share`` of
            the beams still fit the map.
        keep: passes of one place, 0.4 m and 45 deg around, whose keyframes are kept.
        history: keep the pose of keyframes whose scan has been let go; for replay, which needs them once at the end.
        localise: a map that was restored is only used: it never moves, and what is laid on top of it is let go soon.
        live_m: metres per cell of a map that is kept up to date for whoever shows it; 0: none is.
        loops: when a place counts as seen before; None: never.
        matcher: the default one, or one to compare it with. weight: of Eq. 15, where the matcher is the paper's.
    """

    far_m: float = 80.0
    quality: float = 0.0
    keyframe_m: float = 0.25
    keyframe_rad: float = 0.26
    keyframe_share: float = 0.7
    keep: int = 2
    history: bool = False
    localise: bool = False
    live_m: float = 0.0
    loops: LoopSettings | None = field(default_factory=LoopSettings)
    matcher: Matcher = Matcher.LINE
    weight: Weight = Weight.INFORMATION
    map: MapSettings = field(default_factory=MapSettings)
    matching: MatchSettings = field(default_factory=MatchSettings)
    noise: MotionNoise = field(default_factory=MotionNoise)


@dataclass(slots=True, eq=False)
class State:
    """All of it; made by :func:`new_state`, changed only by `step`.

    Attributes:
        fused: the filter whose pose is published. light: a second one, of lights and odometry without laser, beside it
            as an independent witness; the same records predict both. absolute: what ties the two together. Both None
            where there is no photodiode.
        T_map_odom: absolute correction. T_map_start: keyframe 0, where the robot was switched on.
        keyframes: by ID, with their scans. places: their IDs by half metre square and eighth of a turn.
        atlas: what the keyframes hang on, and loops.
        live: the map as cells, None: nobody asks for it.
        retired: where history is kept, what those let go hang on, and their places there. lone: where light alone held
            the pose, by ID.
        anchor, T_odom_anchor, P_anchor: newest keyframe, where it was laid, covariance of its place in the map.
        next_key: ID of the next keyframe. since_keyframe: scans since the newest. failures: scans in a row that did
            not match. jumps: see `StepResult`. noise_m: range noise learned from residuals, 0 before the first.
        kinship: sums over neighbouring residuals, product and squares, that fade
        (`estimator.scan_matching.residual_correlation`). guessed_s: how long the pose has been carried on by a guess,
        along a direction that nothing held. frozen: ties of a while ago, that light is held against. way: metres
        driven, and turned as keyframes count turns, by the prediction; paces: of them, in keyframes. t_scan,
        T_odom_scan: instant and pose of the latest scan. t_match: of the latest that matched. t_newest_scan: end of the
        latest scan's sweep. bearing_rad: the latest bearings found in order. anew: how often the local map was begun
        anew because nothing fitted the old one. let_go: how many stored maps
            were let go of because the robot is nowhere in them.
        lag: between the stamps of scans and wheels. suspicion: whether the robot was carried off.
        journal: is told of every match before it is fused, None: nobody asks.
    """

    settings: Settings
    fused: Motion = field(default_factory=Motion)
    light: Light | None = None
    absolute: Absolute | None = None
    T_map_odom: Array = field(default_factory=se2.identity)
    T_map_start: Array = field(default_factory=se2.identity)
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    places: dict[Place, list[int]] = field(default_factory=dict)
    atlas: Atlas = field(default_factory=Atlas)
    live: LiveMap | None = None
    retired: dict[int, tuple[Submap, Array]] = field(default_factory=dict)
    lone: dict[int, Submap] = field(default_factory=dict)
    local: LocalMap | None = None
    anchor: int = 0
    T_odom_anchor: Array = field(default_factory=se2.identity)
    P_anchor: Array = field(default_factory=lambda: np.zeros((3, 3)))
    next_key: int = 1
    since_keyframe: int = 0
    failures: int = 0
    anew: int = 0
    let_go: int = 0
    jumps: int = 0
    noise_m: float = 0.0
    kinship: Array = field(default_factory=lambda: np.zeros(2))
    guessed_s: float = 0.0
    way: float = 0.0
    frozen: Frozen = field(default_factory=Frozen)
    paces: int = 0
    t_scan: float = -math.inf
    t_match: float = -math.inf
    T_odom_scan: Array = field(default_factory=se2.identity)
    t_newest_scan: float = -math.inf
    bearing_rad: Array | None = None
    lag: TimeLag = field(default_factory=TimeLag)
    suspicion: Suspicion = field(default_factory=Suspicion)
    journal: Journal | None = None


def new_state(settings: Settings | None = None, lights: LightsSetup | None = None) -> State:
    """A robot that has just been switched on, at the origin of its map.

    Args:
        settings: default ones if None.
        lights: the photodiode, None where there is none.

    Raises:
        ValueError: a stored sample clock outside the profile's range.
    """
    state = State(settings or Settings())
    load(state.settings)
    if state.settings.live_m > 0.0:
        state.live = LiveMap(state.settings.live_m)
    if lights is not None:
        from estimator.fusion.map_odom_filter import Absolute
        from estimator.light_filter.light_channel import Light

        state.light, state.absolute = Light(lights), Absolute()
    return state
