"""What the estimator knows between two steps, and its few settings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator import se2
from estimator.localmap import Keyframe, LocalMap, MapSettings
from estimator.matching import MatchSettings
from estimator.motion import Motion, MotionNoise
from estimator.records import Array


@dataclass(frozen=True, slots=True)
class Settings:
    """One set for every robot and lidar; what differs between devices comes with each scan.

    Attributes:
        far_m: L of the paper's quality filter; ranges beyond it are not used.
        quality: Q of the filter; a beam whose intensity is lower is not used (only where a scan has intensities).
        keyframe_m, keyframe_rad: a keyframe is laid after this much motion.
        history: keep the pose of keyframes whose scan has been dropped; for replay, which needs them once at the end.
    """

    far_m: float = 80.0
    quality: float = 0.0
    keyframe_m: float = 0.25
    keyframe_rad: float = 0.26
    history: bool = False
    map: MapSettings = field(default_factory=MapSettings)
    matching: MatchSettings = field(default_factory=MatchSettings)
    noise: MotionNoise = field(default_factory=MotionNoise)


@dataclass(slots=True, eq=False)
class State:
    """All of it; made by :func:`new_state`, changed only by `step`.

    Attributes:
        T_map_odom: absolute correction. T_map_start: keyframe 0, where the robot was switched on.
        keyframes: by ID, with their scans..
        anchor, T_odom_anchor, P_anchor: newest keyframe, where it was laid, covariance of its place in the map.
        next_key: ID of the next keyframe. jumps: see `StepResult`.
        t_scan, T_odom_scan: instant and pose of the latest scan.
    """

    settings: Settings
    motion: Motion = field(default_factory=Motion)
    T_map_odom: Array = field(default_factory=se2.identity)
    T_map_start: Array = field(default_factory=se2.identity)
    keyframes: dict[int, Keyframe] = field(default_factory=dict)
    local: LocalMap | None = None
    anchor: int = 0
    T_odom_anchor: Array = field(default_factory=se2.identity)
    P_anchor: Array = field(default_factory=lambda: np.zeros((3, 3)))
    next_key: int = 1
    jumps: int = 0
    noise_m: float = 0.0
    t_scan: float = -np.inf
    T_odom_scan: Array = field(default_factory=se2.identity)


def new_state(settings: Settings | None = None) -> State:
    """A robot that has just been switched on, at the origin of its map."""
    return State(settings or Settings())
