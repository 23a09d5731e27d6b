"""The state of the estimator between two steps, by owners, and its settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from estimator.fusion.map_pose import MapPose, SurveyAlignment
from estimator.fusion.motion_model import Motion, MotionNoise
from estimator.fusion.time_offset import TimeOffset
from estimator.job_queue import JobQueue
from estimator.mapping.live_grid import LiveGrid
from estimator.mapping.map_state import MappingSettings, MapState
from estimator.mapping.submap_graph import SubmapGraph
from estimator.measurements import Scan
from estimator.relocalisation.memory import RelocalisationMemory
from estimator.result import MatchResult, Virtual
from estimator.scan_matching import scan_matcher
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.local_map import MapSettings
from estimator.scan_matching.match_memory import MatchMemory
from estimator.scan_matching.scan_matcher import Asked, MatchSettings, ScanMatcher

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel, LightsSetup

Journal = Callable[[Scan, ScanPoints, Asked | None, MatchResult], None]
"""Takes a scan, its points, what the matcher was given (None where it was not called) and its result. It may keep all
of them: none is changed later. It must not change anything."""


@dataclass(frozen=True, slots=True)
class Settings(MappingSettings):
    """One set for every robot and lidar; what differs between devices comes with each scan.

    Attributes:
        far_m: L of the paper's quality filter; ranges beyond it are not used.
        quality: Q of the filter; a beam whose intensity is lower is not used (only where a scan has intensities).
        match: the scan matcher. newest_only: it matches with the newest keyframe alone, so a keyframe is laid only a
            whole step away from the one before, whose error stays for good.
        light_pose: gives the light solution that a keyframe keeps, where it is not that of the pipeline's own light
            filter; None where there is no such solution.
        map: of the local map. matching: of the matcher. noise: of the motion.
    """

    far_m: float = 80.0
    quality: float = 0.0
    match: ScanMatcher = scan_matcher.match
    newest_only: bool = False
    light_pose: Callable[[], Virtual | None] | None = None
    map: MapSettings = field(default_factory=MapSettings)
    matching: MatchSettings = field(default_factory=MatchSettings)
    noise: MotionNoise = field(default_factory=MotionNoise)


@dataclass(slots=True, eq=False)
class State:
    """All of it; made by :func:`new_state`, changed only by `step`.

    Attributes:
        motion: the pose in the odom frame, as predicted and matched. light: decoder and light filter, the witness
            beside the laser, moved by the same records; None where there is no photodiode.
        pose: the pose in the map: T_map_odom, its anchor, and the alignment with the survey.
        matching: what scan matching remembers. map: keyframes, submap graph and live grid.
        relocalisation: where in the map the robot may be, while that is in doubt.
        time_offset: between the stamps of scans and wheels. jobs: background work.
        journal: is called with every match before it is fused, None: nobody asks.
    """

    settings: Settings
    map: MapState
    jobs: JobQueue
    motion: Motion = field(default_factory=Motion)
    light: LightChannel | None = None
    pose: MapPose = field(default_factory=MapPose)
    matching: MatchMemory = field(default_factory=MatchMemory)
    relocalisation: RelocalisationMemory = field(default_factory=RelocalisationMemory)
    time_offset: TimeOffset = field(default_factory=TimeOffset)
    journal: Journal | None = None

    def use(self, settings: Settings) -> None:
        """Go on with other settings; whether a live grid is kept is decided at the start."""
        self.settings = self.map.settings = settings


def new_state(settings: Settings | None = None, lights: LightsSetup | None = None) -> State:
    """A robot that has just been switched on, at the origin of its map.

    Args:
        settings: default ones if None.
        lights: the photodiode, None where there is none.

    Raises:
        ValueError: a stored sample clock outside the profile's range.
    """
    settings, jobs = settings or Settings(), JobQueue()
    state = State(settings, MapState(settings, SubmapGraph(jobs)), jobs)
    if settings.live_m > 0.0:
        state.map.live = LiveGrid(settings.live_m)
    if lights is not None:
        from estimator.light_filter.light_channel import LightChannel

        state.light, state.pose.alignment = LightChannel(lights), SurveyAlignment()
    return state
