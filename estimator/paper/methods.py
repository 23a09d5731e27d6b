"""Methods that run by name, with one interface: the paper's as printed, its baseline pIC, and the daemon's own.

The equations of the paper's method, and their code:

| paper | what | where |
|---|---|---|
| Eq. 1, 2 | a lamp's RSS; inverted, its distance | `lateration_model.usable` |
| Eq. 3, 4 | position by the Link_n shortest links (4, solver `ls`) | `shortest_link.select`, `lateration.locate` |
| Eq. 5-7 | the EKF of positions and odometry: the virtual components | `light_pose.LightPose` |
| Eq. 8, 9 | probability of the scan at a pose | `beam_model.mean_log` |
| Eq. 10-12 | virtual frame and fused axis: the distance region | `point_to_point.pair_up` |
| Eq. 13 | T1 from light, T2 from the lidar | `first_transform.from_light`, `point_to_point_sums.closed_form` |
| Eq. 14, 15 | both weighted by one number | `pose_weighting.combine`, `pose_weighting.paper_weight` |
| Sect. 4.2 | scan to scan: all of this until convergence | `registration.PointToPoint` |
| Sect. 4.3 | scan to map: the same weight on the pose in the map, at keyframes | `PaperMethod.step` |
| Sect. 4.3 | the pause: no light at all while fewer than Link_n links are clear | `shortest_link.select` |

Deskew, keyframes, submaps, loop closure and pose graph are the pipeline's in every method.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Final, Protocol

import numpy as np

from estimator import pipeline
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.map_frame import apply_correction
from estimator.measurements import Command, Lap, Limits, Odometry, Order, Record, Scan, no_lap
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.paper.first_transform import First, from_light, predicted
from estimator.paper.lateration_model import LINK_N
from estimator.paper.light_pose import LightPose
from estimator.paper.pose_weighting import combine
from estimator.paper.registration import Pic, PointToPoint
from estimator.result import StepResult, Virtual
from estimator.scan_matching.local_map import PlacedScan
from estimator.scan_matching.scan_matcher import Prior
from estimator.state import Settings, State


class Method(Protocol):
    """Interface of an estimator with its state. ``lit``: whether it uses a photodiode."""

    @property
    def lit(self) -> bool:
        """Whether it uses a photodiode."""

    @property
    def state(self) -> State:
        """Keyframes, map and settings, as input of `pipeline.keyframe_poses` and `pipeline.render_map`."""

    def step(self, records: Iterable[Record], limits: Limits, lap: Lap = no_lap) -> StepResult:
        """Process the records since the last step; as `pipeline.step`."""


class PipelineMethod:
    """The pipeline as it is, with the given settings."""

    def __init__(self, settings: Settings, lights: LightsSetup | None) -> None:
        """Create the state of a start; raises ValueError as `pipeline.new_state`."""
        self.state = pipeline.new_state(settings, lights)
        self.lit = lights is not None

    def step(self, records: Iterable[Record], limits: Limits, lap: Lap = no_lap) -> StepResult:
        """Process the records since the last step."""
        return pipeline.step(self.state, records, limits, lap)


def pic(settings: Settings, lights: LightsSetup | None) -> Method:
    """The paper's baseline: pIC on the newest keyframe, without light."""
    return PipelineMethod(replace(settings, match=Pic(settings.far_m), newest_only=True, calibrate=False), None)


class PaperMethod:
    """The paper's method. Without a photodiode T1 is the prediction and has no weight.

    Attributes:
        light: the light solution, None without a photodiode.
        matcher: the scan matcher, with T1 from it.
        aligned: whether the map frame is the survey frame.
    """

    def __init__(self, settings: Settings, lights: LightsSetup | None, link_n: int = LINK_N) -> None:
        """Create the state of a start; raises ValueError for an impossible survey or sample clock."""
        self.light = None if lights is None else LightPose(lights, settings.noise, link_n)
        self.lit = lights is not None
        self.matcher = PointToPoint(settings.far_m, first=self._first)
        self.aligned = False
        printed = replace(settings, match=self.matcher, newest_only=True, calibrate=False, light_pose=self._virtual)
        self.state = pipeline.new_state(printed)
        self._before: tuple[float, Array] | None = None

    def step(self, records: Iterable[Record], limits: Limits, lap: Lap = no_lap) -> StepResult:
        """Process the records since the last step: light first, up to the scan; then the scan, with T1 from light."""
        ordered = sorted(records, key=pipeline.order)
        if self.light is None:
            return pipeline.step(self.state, ordered, limits, lap)
        t_scan = next((record.t_end for record in ordered if isinstance(record, Scan)), math.inf)
        for record in ordered:
            if -math.inf < pipeline.order(record)[0] <= t_scan:
                self.light.receive(record)
        lap("lights")
        result = pipeline.step(self.state, ordered, limits, lap)
        self._predict_without_odometry(result)
        for record in ordered:
            if pipeline.order(record)[0] > t_scan:
                self.light.receive(record)
            if isinstance(record, Command) and record.order in (Order.RESET, Order.SET_POSE):
                self.aligned = False
        self.light.search(limits.codes)
        if result.keyframe >= 0:
            self._scan_to_map(result)
        return replace(
            result,
            T_map_odom=self.state.pose.T_map_odom,
            jumps=self.state.pose.jumps,
            lights=self.light.result,
            placed=self.aligned,
            protection=None,
        )

    def _virtual(self) -> Virtual | None:
        """The light solution at the pipeline's present instant; None while light is paused."""
        return None if self.light is None else self.light.virtual(self.state.motion.t_mono)

    def _first(self, prior: Prior, reference: PlacedScan) -> First:
        """T1: from light where reference and scan both have a light solution, else the prediction."""
        now = self._virtual()
        if self.light is None or now is None or reference.virtual is None:
            return predicted(prior, reference)
        return from_light(reference, now, self.light.misfit())

    def _scan_to_map(self, result: StepResult) -> None:
        """Eq. 14 for a keyframe in the map: T1 is the light solution, T2 the pose by the lidar, the weight as matched.

        The first light solution aligns the whole map. Later ones move the newest submap with the robot.
        """
        light = self._virtual()
        if light is None:
            return
        T2 = se2.compose(result.T_map_odom, result.T_odom_base)
        T, since = light.T_map_base, 0
        if self.aligned:
            T, since = np.empty(3), result.keyframe
            combine(light.T_map_base, T2, self.matcher.share * np.eye(3), T)
        T_map_odom = se2.compose(T, se2.inverse(result.T_odom_base))
        apply_correction(self.state.map, self.state.pose, T_map_odom, since, result.T_odom_base)
        self.aligned = True

    def _predict_without_odometry(self, result: StepResult) -> None:
        """Without odometry, the motion between steps moves the light solution."""
        assert self.light is not None
        before, self._before = self._before, (result.t_mono, result.T_odom_base)
        if before is not None and not self.state.motion.odometry:
            self.light.predict(Odometry(before[0], result.t_mono, se2.between(before[1], result.T_odom_base)))


BY_NAME: Final[dict[str, Callable[[Settings, LightsSetup | None], Method]]] = {
    "lumiloop": PipelineMethod,
    "paper": PaperMethod,
    "pic": pic,
}
