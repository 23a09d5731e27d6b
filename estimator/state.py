"""Estimator state between two steps, divided by owner, and the estimator settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from estimator.fusion.map_pose import MapPose, SurveyAlignment
from estimator.fusion.motion_model import Motion, MotionNoise
from estimator.fusion.time_offset import TimeOffset
from estimator.fusion.wheel_calibration import WheelCalibration
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
"""Receives a scan, its points, the matcher's arguments (None where it was not called) and its result.

It may keep all of them: none is changed later. It must not change anything.
"""


@dataclass(frozen=True, slots=True)
class Settings(MappingSettings):
    """One set for every robot and lidar; device properties come with each scan.

    Attributes:
        far_m: L of the paper's quality filter; longer ranges are not used.
        quality: Q of the filter; beams of lower intensity are not used (only where a scan has intensities).
        match: the scan matcher.
        newest_only: it matches with the newest keyframe alone. A keyframe is then created only a whole step away from
            the previous one, because its error stays for good.
        calibrate: errors of wheels and lidar mount are estimated and corrected.
        light_pose: returns the light solution of a keyframe, where it is not that of the pipeline's own light filter;
            None where there is no such solution.
        map: of the local map.
        matching: of the matcher.
        noise: of the motion.
    """

    far_m: float = 80.0
    quality: float = 0.0
    match: ScanMatcher = scan_matcher.match
    newest_only: bool = False
    calibrate: bool = True
    light_pose: Callable[[], Virtual | None] | None = None
    map: MapSettings = field(default_factory=MapSettings)
    matching: MatchSettings = field(default_factory=MatchSettings)
    noise: MotionNoise = field(default_factory=MotionNoise)


@dataclass(slots=True, eq=False)
class State:
    """The whole state; created by :func:`new_state`, changed only by `step`.

    Attributes:
        settings: of the estimator.
        map: keyframes, submap graph and live grid.
        jobs: background work.
        motion: the pose in the odom frame, as predicted and matched.
        light: decoder and light filter, independent of the lidar, with the same records; None without a photodiode.
        pose: the pose in the map: T_map_odom, its anchor, and the alignment with the survey.
        matching: state of scan matching.
        relocalisation: hypotheses of the pose in the map, while it is not known.
        time_offset: between the stamps of scans and odometry.
        wheels: lasting errors of odometry and lidar mount.
        journal: called with every match before it is fused, None without a journal.
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
    wheels: WheelCalibration = field(default_factory=WheelCalibration)
    journal: Journal | None = None

    def use(self, settings: Settings) -> None:
        """Continue with other settings; the live grid is decided at the start only."""
        self.settings = self.map.settings = settings


def new_state(settings: Settings | None = None, lights: LightsSetup | None = None) -> State:
    """State at a start, at the origin of the map.

    Args:
        settings: default ones if None.
        lights: the photodiode, None without one.

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
