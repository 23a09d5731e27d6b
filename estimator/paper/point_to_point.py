"""The paper's matcher (Sect. 4.2): closed-form point-to-point, with T1 from light weighted in by probability.

    T1 -> virtual frame (Eq. 10-11) -> fused axis (Eq. 12) -> pairs -> T2 (Eq. 13) -> weight (Eq. 15) -> T_k (Eq. 14)

T1 is that of `estimator.paper.first_transform`. The reference is the newest keyframe's scan in its lidar's frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimator.measurements import Beams
from estimator.numerics import se2
from estimator.numerics.arrays import Array, Ints
from estimator.paper import beam_model, point_to_point_sums
from estimator.paper.first_transform import First
from estimator.paper.pose_weighting import combine, information_weight, moved, paper_weight, turned, twist_between
from estimator.scan_matching import icp
from estimator.scan_matching.distance_axis import Axis, build_axis
from estimator.scan_matching.distance_region import Fused, fuse, pair_fused

CENTRE = np.zeros(2)
"""Centre of the reference's axis: its lidar."""
PROBES = 4
"""Steps along the normals that estimate the solution's own error."""


@dataclass(frozen=True, slots=True, eq=False)
class Reference:
    """The reference frame S_ref: a scan's points on the single distance axis, with their surfaces.

    Attributes:
        axis: around the lidar.
        surfaces: (n, 4) per row, see `point_to_point_sums.surfaces`.
        segments: between neighbours, for the beam model.
    """

    axis: Axis
    surfaces: Array
    segments: Array


@dataclass(frozen=True, slots=True, eq=False)
class New:
    """The target frame S_new.

    Attributes:
        points: (m, 2) in the base frame.
        T_base_lidar: mount.
        beams: of the scan.
        noise_m: range noise.
    """

    points: Array
    T_base_lidar: Array
    beams: Beams
    noise_m: float


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the iteration.

    Attributes:
        cap: most iterations.
        gate_m: farthest partner, m.
        scale_m: last robust scale, m.
        settled_m: final remaining displacement, m.
        scalar: whether the weight is the paper's scalar.
    """

    cap: int
    gate_m: float
    scale_m: float
    settled_m: float
    scalar: bool


@dataclass(slots=True, eq=False)
class Course:
    """State of the iteration: pose, robust scale, steps, and the sums and trace for `scan_matcher.verdict`.

    ``share``: the scalar weight of T1 in the latest iteration; 0 with a matrix weight.
    """

    T: Array
    scale: float
    lever: float
    way: float = math.inf
    damping: float = 1.0
    share: float = 0.0
    before: Array = field(default_factory=lambda: np.zeros(3))
    sums: Array = field(default_factory=lambda: np.zeros(icp.SUMS))
    trace: list[Array] = field(default_factory=list)

    @property
    def settled(self) -> bool:
        """Whether it has converged."""
        return bool(self.sums[icp.SETTLED])


def reference_of(xy: Array, noise_m: float, lights: Array | None = None) -> Reference:
    """Reference of a scan's points (n, 2), in order of measurement around their lidar, on the axis (Eq. 10).

    ``lights``: (k, 2) light points in the same frame, which lie on the axis too and are no lidar point's partner.
    """
    surfaces = np.empty((len(xy), 4))
    point_to_point_sums.surfaces(xy, noise_m, surfaces)
    axis = build_axis(xy, CENTRE, sectors=1, lights=lights)
    return Reference(axis, surfaces[axis.label], beam_model.segments_of(xy))


def register(new: New, reference: Reference, first: First, limits: Limits) -> tuple[Course, Array]:
    """Sect. 4.2 until convergence: the final state, and the lidar's information of its pose in the same axes.

    ``first``: T1 in the reference lidar's frame, the start, with its information in T1's own axes.
    """
    course, fused = begin(new, first, limits), None
    T2, after, moments, W = course.T.copy(), np.empty(3), np.empty(9), np.zeros((3, 3))
    while len(course.trace) < limits.cap and not course.settled:
        gate = min(limits.gate_m, max(6.0 * course.scale, 0.1))
        fused, partner = pair_up(new, reference, course.T, gate, fused)
        pairs = reference.axis.rows, reference.surfaces, partner
        point_to_point_sums.sum_up(new.points, pairs, course.T, course.scale, (moments, course.sums))
        note(course, gate, len(new.points))
        if not point_to_point_sums.closed_form(moments, T2):
            break
        if limits.scalar:
            paper_weight(*likelihoods(new, reference, first, course.T), W)
            course.share = float(W[0, 0])
        combine(first.T, T2, W, after)
        advance(course, after, limits)
    H = information(new, reference, course)
    if not limits.scalar:
        L2 = np.empty((3, 3))
        turned(H, course.T[2], L2)
        information_weight(first.L, L2, W)
        combine(first.T, course.T.copy(), W, course.T)
    return course, H


def begin(new: New, first: First, limits: Limits) -> Course:
    """Start at T1; the robust scale is the displacement of a point by its uncertainty."""
    lever = max(0.1, icp.mean_lever(new.points, new.T_base_lidar[:2]))
    L = first.L
    spread = math.sqrt(1.0 / L[0, 0] + 1.0 / L[1, 1] + lever * lever / L[2, 2])
    return Course(first.T.copy(), min(max(limits.scale_m, 2.0 * spread), 0.5 * limits.gate_m), lever)


def pair_up(new: New, reference: Reference, T: Array, gate: float, before: Fused | None) -> tuple[Fused, Ints]:
    """Step 1: the virtual frame at ``T`` on the fused axis (Eq. 10-12), and each point's partner, -1 where none."""
    fused = fuse(reference.axis, new.points, T, before=before)
    partner, _, _ = pair_fused(reference.axis, fused, gate)
    return fused, partner


def likelihoods(new: New, reference: Reference, first: First, T: Array) -> tuple[float, float]:
    """Logarithms of ``rho_1 p_1`` (Eq. 6, the light's links) and ``rho_2 p_2`` (Eq. 8-9, the beams) at the pose ``T``.

    Light's deviations are the residuals of its links, and the distance of the pose from T1. Without a clear link light
    has no weight: the paper's pause.
    """
    if not first.links:
        return -math.inf, 0.0
    away = np.empty(3)
    twist_between(first.T, T, away)
    log1 = -0.5 * (first.misfit + float(away @ first.L @ away) / first.links)
    model = beam_model.BeamModel(sigma_m=2.0 * new.noise_m)
    return log1, beam_model.mean_log(reference.segments, se2.compose(T, new.T_base_lidar), new.beams, model)


def advance(course: Course, after: Array, limits: Limits) -> None:
    """Step towards ``after`` and test for convergence.

    A closed-form step leaves a constant share of the remaining displacement, so the remainder can be estimated. The
    displacement counts along the surfaces' normals. Along a bare corridor pairs creep without end, which does not
    matter. A step that reverses the previous one is halved, since pairs may alternate between two sets. The robust
    scale shrinks no faster than the steps do.
    """
    step, last = np.empty(3), course.scale == limits.scale_m
    twist_between(course.T, after, step)
    scaled = step * (1.0, 1.0, course.lever)
    if last and float(scaled @ course.before) < -0.25 * float(scaled @ scaled):
        course.damping = max(0.125, 0.5 * course.damping)
    length = along(course.sums, after - course.T)
    moved(course.T, course.damping * step, course.T)
    share = min(0.95, length / course.way) if course.way > 0.0 else 0.0
    remains = course.damping * length * share / (1.0 - share)
    course.way, course.before = length, scaled
    course.sums[icp.LENGTH2], course.sums[icp.DAMPING] = (remains / limits.settled_m) ** 2, course.damping
    course.trace[-1][icp.STEP2], course.trace[-1][icp.DAMPED] = course.sums[icp.LENGTH2], course.damping
    done = last and remains < limits.settled_m and length < 5.0 * limits.settled_m
    course.sums[icp.SETTLED] = 1.0 if done else 0.0
    course.scale = max(limits.scale_m, min(course.scale, max(0.5 * course.scale, 2.0 * length)))


def along(sums: Array, step: Array) -> float:
    """Root mean square displacement (m) of the pairs along their normals by a step (x, y, yaw).

    ``sums``: of `point_to_point_sums.sum_up`. Without pairs it is the length of the step itself.
    """
    x, y, yaw = step[0], step[1], se2.wrap(float(step[2]))
    square = sums[0] * x * x + sums[3] * y * y + sums[5] * yaw * yaw
    square += 2.0 * (sums[1] * x * y + sums[2] * x * yaw + sums[4] * y * yaw)
    weights = sums[icp.WEIGHTS]
    return math.sqrt(max(float(square), 0.0) / weights) if weights > 0.0 else math.hypot(x, y)


def note(course: Course, gate: float, sought: int) -> None:
    """Append a row to the trace, in the layout of `icp`."""
    row = np.zeros(icp.TRACE)
    row[icp.AT_X : icp.AT_YAW + 1] = course.T
    row[icp.SCALE], row[icp.GATE], row[icp.STRIDE], row[icp.SOUGHT] = course.scale, gate, 1.0, sought
    row[icp.FITTED : icp.SQUARED + 1] = course.sums[icp.INLIERS : icp.SQUARES + 1]
    course.trace.append(row)


def information(new: New, reference: Reference, course: Course) -> Array:
    """The lidar's information at the solution, see `point_to_point_sums`; pose-centred in the reference's axes."""
    A, B, g, d, H = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3), np.zeros((3, 3))
    T, fused, gate = course.T.copy(), None, max(6.0 * course.scale, 0.1)
    for _ in range(PROBES):
        fused, partner = pair_up(new, reference, T, gate, fused)
        pairs = reference.axis.rows, reference.surfaces, partner
        point_to_point_sums.along_normals(new.points, pairs, T, (course.scale, new.noise_m), (A, B, g))
        point_to_point_sums.step_along(A, g, new.noise_m, d)
        T += d
    point_to_point_sums.information(A, B, T - course.T, H)
    return H
