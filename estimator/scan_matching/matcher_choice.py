"""Which matcher a state uses: the default one, the paper's, or the paper's baseline; all give a `MatchResult`.

The two others are for experiments. They match against the newest keyframe's scan, as the paper does, and are compiled
only where a state asks for them.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from estimator.measurements import Beam
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import LightsResult, LinkState, MatchResult, Reason, Virtual
from estimator.scan_matching import icp, scan_matcher
from estimator.scan_matching.distance_axis import build_axis
from estimator.scan_matching.local_map import PlacedScan
from estimator.scan_matching.scan_matcher import Asked, Attempt, Prior, View

if TYPE_CHECKING:
    from estimator.state import Settings

CENTRE = np.zeros(2)
"""Of the reference's axis: its lidar."""
SETTLED_M = 2e-4
"""Way that may remain when an iteration ends: a fifth of what range noise leaves uncertain in a room."""
LIKELY = np.diag((0.02**2, 0.02**2, 0.005**2))
"""No relative pose from light is better than this: stamps, and errors of the light model that differ from place to
place."""


class Matcher(Enum):
    """How a scan is matched."""

    LINE = "point-to-line on the local map, the prediction weighed in as information"
    POINT = "the paper's: point-to-point on the newest keyframe, light's transform weighed in"
    PIC = "the paper's baseline: probabilistic iterative correspondence on the newest keyframe"


class Weight(Enum):
    """How Eq. 15 weighs T1 against T2 in the paper's matcher."""

    INFORMATION = "matrix (L1 + L2)^-1 L1: each direction from the witness that knows it"
    PAPER = "scalar ratio of the probabilities of both measurements at the present pose, in each iteration"


@dataclass(frozen=True, slots=True, eq=False)
class First:
    """T1 of Eq. 14, and how well it explains its own measurement (Eq. 6).

    Attributes:
        T: pose of the new base. L: information of it, in the axes of the frame it is given in.
        misfit: mean squared deviation of the links. links: their number, 0 where there is no clear one.
    """

    T: Array
    L: Array
    misfit: float = 0.0
    links: int = 0


def load(settings: Settings) -> None:
    """Compile what these settings need, so that no cycle has to."""
    if settings.matcher is Matcher.POINT:
        import estimator.paper.point_to_point
    elif settings.matcher is Matcher.PIC:
        import estimator.paper.pic  # noqa: F401  # imported to be compiled


def first_of(prior: Prior, newest: PlacedScan | None, now: Virtual | None, lights: LightsResult | None) -> First:
    """T1 from light where both the keyframe and this instant have a good position from it, else the prediction.

    ``X_ref^-1 X_new`` of the `lights` filter, hung on the keyframe. How the two positions' errors hang together is not
    known; taking their sum for the relative error never claims too much.
    """
    if newest is None or newest.virtual is None or now is None or lights is None:
        return First(prior.T, prior.L)
    links = [(link.residual, link.sigma) for link in lights.links if link.state is LinkState.ACCEPTED]
    used = [residual / sigma for residual, sigma in links if residual is not None and sigma]
    if not used:
        return First(prior.T, prior.L)
    ref = newest.virtual
    relative = se2.between(ref.T_map_base, now.T_map_base)
    T = se2.compose(newest.T_odom_keyframe, relative)
    R = se2.rotation(newest.T_odom_keyframe[2] - ref.T_map_base[2])
    P = R @ (se2.carry(ref.T_map_base, relative, ref.covariance) + now.covariance) @ R.T
    misfit = float(np.mean(np.square(used)))
    return First(T, invert3(np.ascontiguousarray(P + LIKELY)), misfit, len(used))


def match(asked: Asked, first: First, settings: Settings) -> MatchResult:
    """Match a scan against the newest keyframe's, by the paper's matcher or by pIC."""
    view, local, prior, cap, _ = asked
    newest = local.newest
    if newest is None:
        return scan_matcher.no_match(prior.T, len(view.points), Reason.NO_MAP)
    xy = points_of(newest, settings.far_m)
    if settings.matcher is Matcher.POINT:
        best = by_points(view, newest, xy, first, cap, settings)
    else:
        best = by_pic(view, newest, xy, prior, cap, settings)
    return scan_matcher.verdict(best, local, prior, settings.matching)


def points_of(frame: PlacedScan, far_m: float) -> Array:
    """A keyframe's points (n, 2) in its lidar's frame, in order of measurement, those farther than L left out."""
    bearing, distance, kind = frame.beams()
    hit = (kind == Beam.HIT) & (distance > 0.0) & (distance <= far_m)
    angle, r = bearing[hit], distance[hit]
    return np.column_stack((r * np.cos(angle), r * np.sin(angle)))


def by_points(view: View, frame: PlacedScan, xy: Array, first: First, cap: int, settings: Settings) -> Attempt:
    """The paper's matcher, see point_to_point.py."""
    from estimator.paper import point_to_point

    eye, how = frame.T_odom_lidar, settings.matching
    here = First(se2.between(eye, first.T), turned_back(first.L, first.T[2]), first.misfit, first.links)
    new = point_to_point.New(np.ascontiguousarray(view.points[:, :2]), view.T_base_lidar, view.beams, view.noise_m)
    scalar = settings.weight is Weight.PAPER
    limits = point_to_point.Limits(cap, how.gate_m, how.scale * view.noise_m, SETTLED_M, scalar)
    course, H = point_to_point.register(new, point_to_point.reference_of(xy, view.noise_m), here, limits)
    trace = np.array(course.trace).reshape(-1, icp.TRACE)
    T, told = se2.compose(eye, course.T), Prior(first.T, first.L)
    return Attempt(T, turned_back(H, -eye[2]), course.sums, len(trace), len(view.points), trace, view, told)


def by_pic(view: View, frame: PlacedScan, xy: Array, prior: Prior, cap: int, settings: Settings) -> Attempt:
    """The paper's baseline, see pic.py."""
    from estimator.paper import pic

    axis = build_axis(xy, CENTRE)
    eye = frame.T_odom_lidar
    T = se2.between(eye, prior.T)
    P = invert3(turned_back(prior.L, eye[2]))
    bearing = frame.bearing_rad
    across = abs(float(bearing[-1] - bearing[0])) / max(1, len(bearing) - 1) / np.sqrt(12.0) if len(bearing) else 0.0
    mount = view.T_base_lidar
    how = np.array((cap, view.noise_m, across, SETTLED_M, mount[0], mount[1]))
    H, sums, trace = np.zeros((3, 3)), np.zeros(icp.SUMS), np.zeros((cap, icp.TRACE))
    n = pic.iterate(view.points, (axis.rows, axis.start, axis.rays), T, P, how, (H, sums, trace))
    return Attempt(se2.compose(eye, T), turned_back(H, -eye[2]), sums, n, len(view.points), trace[:n], view, prior)


def turned_back(L: Array, yaw: float) -> Array:
    """Information in the axes of a frame that stands at ``yaw`` in the present one."""
    R = se2.rotation(yaw)
    return np.ascontiguousarray(R.T @ L @ R)
