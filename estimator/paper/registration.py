"""The paper's point-to-point matcher and pIC as matchers for `Settings.match`, against the newest keyframe's scan."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.measurements import Beam
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.paper import pic, point_to_point
from estimator.paper.first_transform import First, predicted
from estimator.paper.pose_weighting import Weight
from estimator.result import MatchResult, Reason
from estimator.scan_matching import icp, scan_matcher
from estimator.scan_matching.distance_axis import build_axis
from estimator.scan_matching.local_map import LocalMap, PlacedScan
from estimator.scan_matching.scan_matcher import Attempt, MatchSettings, Prior, View

FAR_M: Final = 80.0
"""L of the quality filter by default, m (`Settings.far_m`)."""
SETTLED_M: Final = 2e-4
"""Remaining displacement that ends the iteration, m: a fifth of the uncertainty by range noise in a room."""


def points_of(frame: PlacedScan, far_m: float) -> Array:
    """A keyframe's points (n, 2) in its lidar's frame, in order of measurement, without those beyond L."""
    bearing, distance, kind = frame.beams()
    hit = (kind == Beam.HIT) & (distance > 0.0) & (distance <= far_m)
    angle, r = bearing[hit], distance[hit]
    return np.column_stack((r * np.cos(angle), r * np.sin(angle)))


@dataclass(slots=True, eq=False)
class PointToPoint:
    """The paper's matcher (Sect. 4.2): point to point on the distance region, with T1 weighted in.

    Attributes:
        far_m: L of the quality filter.
        weight: form of Eq. 15.
        first: returns T1 for a prediction and the reference keyframe; the prediction itself by default.
        share: scalar weight of T1 in the latest match, 0 to 1; 0 with a matrix weight.
    """

    far_m: float = FAR_M
    weight: Weight = Weight.PAPER
    first: Callable[[Prior, PlacedScan], First] = predicted
    share: float = 0.0

    def __call__(self, view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, /) -> MatchResult:
        """Match a scan with the newest keyframe's."""
        self.share = 0.0
        if local.newest is None:
            return scan_matcher.no_match(prior.T, len(view.points), Reason.NO_MAP)
        best = self.attempt(view, local.newest, self.first(prior, local.newest), cap, settings)
        return scan_matcher.verdict(best, local, prior, settings)

    def attempt(self, view: View, frame: PlacedScan, first: First, cap: int, settings: MatchSettings) -> Attempt:
        """Iterate from T1 until it converges, see point_to_point.py."""
        eye = frame.T_odom_lidar
        here = First(se2.between(eye, first.T), turned_back(first.L, first.T[2]), first.misfit, first.links)
        new = point_to_point.New(np.ascontiguousarray(view.points[:, :2]), view.T_base_lidar, view.beams, view.noise_m)
        reference = point_to_point.reference_of(points_of(frame, self.far_m), view.noise_m)
        scale = settings.scale * view.noise_m
        limits = point_to_point.Limits(cap, settings.gate_m, scale, SETTLED_M, self.weight is Weight.PAPER)
        course, H = point_to_point.register(new, reference, here, limits)
        self.share = course.share
        trace = np.array(course.trace).reshape(-1, icp.TRACE)
        T, start = se2.compose(eye, course.T), Prior(first.T, first.L)
        return Attempt(T, turned_back(H, -eye[2]), course.sums, len(trace), len(view.points), trace, view, start)


@dataclass(frozen=True, slots=True)
class Pic:
    """The paper's baseline, see pic.py. ``far_m``: L of the quality filter."""

    far_m: float = FAR_M

    def __call__(self, view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, /) -> MatchResult:
        """Match a scan with the newest keyframe's."""
        if local.newest is None:
            return scan_matcher.no_match(prior.T, len(view.points), Reason.NO_MAP)
        return scan_matcher.verdict(self.attempt(view, local.newest, prior, cap), local, prior, settings)

    def attempt(self, view: View, frame: PlacedScan, prior: Prior, cap: int) -> Attempt:
        """Iterate from the prediction until it converges."""
        axis = build_axis(points_of(frame, self.far_m), point_to_point.CENTRE)
        eye, mount = frame.T_odom_lidar, view.T_base_lidar
        T = se2.between(eye, prior.T)
        P = invert3(turned_back(prior.L, eye[2]))
        how = np.array((cap, view.noise_m, bearing_noise(frame.bearing_rad), SETTLED_M, mount[0], mount[1]))
        H, sums, trace = np.zeros((3, 3)), np.zeros(icp.SUMS), np.zeros((cap, icp.TRACE))
        n = pic.iterate(view.points, (axis.rows, axis.start, axis.rays), T, P, how, (H, sums, trace))
        T = se2.compose(eye, T)
        return Attempt(T, turned_back(H, -eye[2]), sums, n, len(view.points), trace[:n], view, prior)


def bearing_noise(bearing_rad: Array) -> float:
    """One sigma (rad) of a beam's bearing: that of a uniform distribution over one step."""
    n = len(bearing_rad)
    return abs(float(bearing_rad[-1] - bearing_rad[0])) / max(1, n - 1) / math.sqrt(12.0) if n else 0.0


def turned_back(L: Array, yaw: float) -> Array:
    """Information in the axes of a frame that has yaw ``yaw`` in the present one."""
    R = se2.rotation(yaw)
    return np.ascontiguousarray(R.T @ L @ R)
