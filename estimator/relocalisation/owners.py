"""Interface to the parts of the estimator state that relocalisation reads and corrects."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from estimator.fusion.map_pose import MapPose
from estimator.fusion.motion_model import Motion
from estimator.fusion.time_offset import TimeOffset
from estimator.mapping.map_state import MapState
from estimator.relocalisation.memory import RelocalisationMemory
from estimator.scan_matching.match_memory import MatchMemory

if TYPE_CHECKING:  # compiles and costs nothing where there is no photodiode
    from estimator.light_filter.light_channel import LightChannel


class Owners(Protocol):
    """Those parts of the estimator's state; see `estimator.state.State`."""

    @property
    def motion(self) -> Motion:
        """The pose in the odom frame."""

    @property
    def light(self) -> LightChannel | None:
        """Decoder and light filter."""

    @property
    def pose(self) -> MapPose:
        """The pose in the map."""

    @property
    def matching(self) -> MatchMemory:
        """State of scan matching."""

    @property
    def map(self) -> MapState:
        """The map."""

    @property
    def relocalisation(self) -> RelocalisationMemory:
        """State of relocalisation."""

    @property
    def time_offset(self) -> TimeOffset:
        """Time offset between the stamps of scans and odometry."""
