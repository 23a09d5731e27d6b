"""Scan-to-map matching: ICP attempt from the prediction, multi-start where it is doubtful, and acceptance test."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from estimator.measurements import Beams
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import VAGUE, MatchResult, Reason
from estimator.scan_matching import icp
from estimator.scan_matching.local_map import LocalMap, contradicted

FIRST, TRIAL, FINISH, LEAST = 20, 10, 12, 8
"""Most iterations of the first attempt and of a trial start; iterations reserved for the last attempt; fewest of it."""

SURE = 0.8
"""Inlier share above which the free-space violation is not tested, unless the pose is far from the prediction."""

FEW = 3.0
"""Prior number of fitting points in each direction, so that a few points there cannot reject a pose."""

CLAIM = 1.15
"""True information over computed information.

A Cauchy weight scales a Gaussian residual by 0.89, but costs only 0.04 of its information. Surfaces at a grazing angle
are weighted less than an ideal beam would justify.
"""


@dataclass(frozen=True, slots=True)
class Demand:
    """Acceptance thresholds of a matched pose.

    Attributes:
        ways: alternatives in falling order, each the smallest inlier share and the largest free-space violation.
        held: the smallest value of :func:`held`.
    """

    ways: tuple[tuple[float, float], ...]
    held: float = 0.0


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Settings of the scan matcher, in physical terms.

    Attributes:
        gate_m: largest distance of a partner.
        scale: final robust scale in units of the noise.
        settled: a step shorter than this share of its own sigma ends the iteration.
        min_points: fewest pairs that give a result.
        tracking: thresholds after a good prediction.
        near: thresholds after an uncertain one, for a pose within ``near_m`` and ``near_rad`` of it.
        far: thresholds for a pose farther away, or where the prediction was wrong; a wrong pose can fit half of the
            scan.
        wide_m, wide_rad: sigma of the prediction above which it counts as uncertain.
        doubt_share, doubt_against: multi-start where fewer beams fit and the free-space violation is larger.
        doubt_m, doubt_rad: smallest sigma of the prediction in a multi-start.
        fan, fan_rad: number of headings tried on either side, and their spacing.
        shift_m: distance of the positions tried then.
        few: most points of a trial.
        coarse, dense: point stride while the pose is far off, in scans of more than ``dense`` points.
    """

    gate_m: float = 0.5
    scale: float = 2.5
    settled: float = 0.3
    min_points: int = 10
    tracking: Demand = Demand(((0.35, 0.35),))
    near: Demand = Demand(((0.6, 0.1), (0.42, 0.02)), held=0.23)
    far: Demand = Demand(((0.6, 0.03), (0.5, 0.01)), held=0.5)
    near_m: float = 0.75
    near_rad: float = 0.6
    wide_m: float = 0.15
    wide_rad: float = 0.1
    doubt_share: float = 0.6
    doubt_m: float = 0.3
    doubt_rad: float = 0.2
    doubt_against: float = 0.02
    fan: int = 3
    fan_rad: float = 0.14
    shift_m: float = 0.4
    few: int = 90
    coarse: int = 4
    dense: int = 400


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """The input of a match.

    Attributes:
        points: (n, 4) position and tangent in the base frame at the scan's end.
        T_base_lidar: mount.
        beams: of the scan, for the free-space test.
        noise_m: assumed range noise.
        alike: beams per independent measurement (`estimator.scan_matching.residual_correlation`).
    """

    points: Array
    T_base_lidar: Array
    beams: Beams
    noise_m: float
    alike: float = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """T1 of Eq. 14: the predicted pose in the odom frame and its information (3, 3)."""

    T: Array
    L: Array


Asked = tuple[View, LocalMap, Prior, int, MatchSettings]
"""The arguments of :func:`match`; with them a match can be repeated, iteration by iteration."""


class ScanMatcher(Protocol):
    """Interface of a scan matcher, against the local map or its newest keyframe; :func:`match` is the default."""

    def __call__(self, view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, /) -> MatchResult:
        """Match a scan from its prediction in at most ``cap`` iterations."""


@dataclass(slots=True, eq=False)
class Attempt:
    """Result of one ICP run from one start.

    Attributes:
        T: pose.
        H: information of the lidar (3, 3).
        sums: of the last pass.
        points: number of queries.
        trace: (iterations, icp.TRACE), a row an iteration; poses relative to the axis centre.
        view, prior: input and start.
        contradicted: free-space violation, see :meth:`against`; None until it is computed.
        demand: thresholds, None before the acceptance test.
    """

    T: Array
    H: Array
    sums: Array
    iterations: int
    points: int
    trace: Array
    view: View
    prior: Prior
    contradicted: float | None = None
    demand: Demand | None = None

    @property
    def share(self) -> float:
        """Inliers as a share of the queries."""
        return float(self.sums[icp.INLIERS]) / max(self.points, 1)

    def against(self, local: LocalMap) -> float:
        """Free-space violation (0 to 1) at the pose; computed once."""
        if self.contradicted is None:
            at = se2.compose(self.T, self.view.T_base_lidar)
            self.contradicted = contradicted(local, at, self.view.beams, self.view.noise_m)
        return self.contradicted

    def score(self, local: LocalMap) -> float:
        """Score of the pose, comparable between poses of the same scan."""
        return self.share - 2.0 * self.against(local)

    def fits(self, local: LocalMap, settings: MatchSettings) -> bool:
        """Whether the pose fits so well that no other start is needed."""
        return self.share > SURE and self.against(local) <= settings.doubt_against


def match(
    view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, tried: list[Attempt] | None = None
) -> MatchResult:
    """Match a scan from its prediction in at most ``cap`` iterations; a doubtful first attempt leads to a multi-start.

    Every attempt is appended to ``tried`` if it is given: the first, the trials of the multi-start, the last.
    """
    tried = [] if tried is None else tried
    first = attempt(view, local, prior, min(cap, FIRST), settings)
    tried.append(first)
    result = verdict(first, local, prior, settings)
    left = cap - first.iterations
    if left < LEAST or not in_doubt(first, result, local, settings):
        return result
    best, passed = second_opinion(local, prior, settings, tried, left * first.points)
    used = first.iterations + -(-passed // max(1, first.points))
    return replace(result if best is first else verdict(best, local, prior, settings), iterations=used)


def reference_of(local: LocalMap) -> icp.Reference:
    """The local map as the arrays of the kernels."""
    return local.axis.rows, local.axis.start, local.axis.rays, local.lines


def attempt(view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings) -> Attempt:
    """Run the ICP iterations from a prediction."""
    H, sums, trace = np.zeros((3, 3)), np.zeros(icp.SUMS), np.empty((cap, icp.TRACE))
    axis, noise = local.axis, view.noise_m
    coarse = settings.coarse if len(view.points) > settings.dense else 1
    tail = (cap, settings.gate_m, settings.scale * noise, noise * math.sqrt(view.alike), settings.settled, coarse)
    how = np.array((view.T_base_lidar[0], view.T_base_lidar[1], *tail))
    centre = np.array((axis.centre[0], axis.centre[1], 0.0))
    T = prior.T - centre
    n = icp.iterate(view.points, reference_of(local), T, prior.L, how, (H, sums, trace))
    return Attempt(T + centre, CLAIM * H, sums, n, len(view.points), trace[:n], view, prior)


def in_doubt(first: Attempt, result: MatchResult, local: LocalMap, settings: MatchSettings) -> bool:
    """Whether another pose may fit better: no result, or too few inliers together with a free-space violation."""
    if not result.ok:
        return True
    least = settings.doubt_share if first.demand is settings.tracking else SURE
    return first.share < least and first.against(local) > settings.doubt_against


def second_opinion(
    local: LocalMap, prior: Prior, settings: MatchSettings, tried: list[Attempt], budget: int
) -> tuple[Attempt, int]:
    """Multi-start: try poses around the prediction on a few points, then finish the best with all points.

    ``tried`` ends with the first attempt; the others are appended. ``budget``: points that all iterations may process,
    a share of which is reserved for the last attempt. Returns the better of first and last, and the points processed.
    """
    first = tried[-1]
    view = first.view
    few = replace(view, points=np.ascontiguousarray(view.points[:: -(-len(view.points) // settings.few)]))
    best, left = first, budget - min(budget // 2, FINISH * first.points)
    for start in starts(prior, tried, settings):
        cap = min(TRIAL, left // len(few.points))
        if cap < 1 or best.fits(local, settings):
            break
        trial = attempt(few, local, start, cap, settings)
        tried.append(trial)
        left -= trial.iterations * len(few.points)
        if trial.share > best.share and trial.score(local) > best.score(local) + 0.03:
            best = trial
    spent = budget - min(budget // 2, FINISH * first.points) - left
    if best is first:
        return first, spent
    cap = (budget - spent) // first.points
    last = attempt(view, local, Prior(best.T, doubted(prior, settings)), cap, settings)
    tried.append(last)
    better = last if last.score(local) > first.score(local) else first
    return better, spent + last.iterations * last.points


def doubted(prior: Prior, settings: MatchSettings) -> Array:
    """Information (3, 3) of the prediction, reduced for a multi-start."""
    most = settings.doubt_m**-2, settings.doubt_m**-2, settings.doubt_rad**-2
    return np.diag(np.minimum(np.diag(prior.L), most))


def starts(prior: Prior, tried: list[Attempt], settings: MatchSettings) -> Iterator[Prior]:
    """Starts of the multi-start: headings around the prediction, then positions around it with the best heading."""
    L = doubted(prior, settings)
    for k in sorted(range(-settings.fan, settings.fan + 1), key=abs):
        yield Prior(prior.T + np.array((0.0, 0.0, k * settings.fan_rad)), L)
    yaw = max(tried, key=lambda trial: trial.share).T[2]
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        yield Prior(np.array((prior.T[0] + x * settings.shift_m, prior.T[1] + y * settings.shift_m, yaw)), L)


def verdict(best: Attempt, local: LocalMap, prior: Prior, settings: MatchSettings) -> MatchResult:
    """Acceptance test of an attempt; returns the match result with its reason."""
    sums, (x, y, yaw), (x1, y1, yaw1) = best.sums.tolist(), best.T.tolist(), prior.T.tolist()
    length2 = sums[icp.LENGTH2]
    T = np.array((x, y, se2.wrap(yaw)))
    correction = np.array((x - x1, y - y1, se2.wrap(yaw - yaw1)))
    best.demand = demand_on(prior, correction, settings)
    if sums[icp.PAIRS] < settings.min_points:
        reason = Reason.TOO_FEW_PAIRS
    elif not plausible(best, best.demand, local, settings):
        reason = Reason.REJECTED
    elif sums[icp.SETTLED]:
        reason = Reason.CONVERGED
    else:
        reason = Reason.OSCILLATING if sums[icp.DAMPING] < 0.5 and length2 > 1.0 else Reason.ITERATION_CAP
    ok = reason in (Reason.CONVERGED, Reason.ITERATION_CAP)
    H = best.H / (1.0 + length2) if ok else np.zeros((3, 3))
    return MatchResult(
        T_odom_base=T if ok else prior.T.copy(),
        information=H,
        inliers=int(sums[icp.INLIERS]),
        queries=best.points,
        iterations=best.iterations,
        residual_m=math.sqrt(sums[icp.SQUARES] / max(sums[icp.WEIGHTS], 1e-9)),
        known_axes=known_axes(H),
        correction=correction,
        reason=reason,
    )


def demand_on(prior: Prior, correction: Array, settings: MatchSettings) -> Demand:
    """Thresholds for a pose: higher if the prediction was uncertain or wrong, highest far away from it."""
    Lx, Ly, Lyaw = prior.L.diagonal().tolist()
    wide = 1.0 / Lx + 1.0 / Ly > settings.wide_m**2 or 1.0 / Lyaw > settings.wide_rad**2
    x, y, yaw = correction.tolist()
    off2, turn = x * x + y * y, abs(yaw)
    surprise = off2 > settings.wide_m**2 or turn > settings.wide_rad
    surprise = surprise and float(correction @ prior.L @ correction) > 25.0
    if not wide and not surprise:
        return settings.tracking
    near = off2 <= settings.near_m**2 and turn <= settings.near_rad and not surprise
    return settings.near if near else settings.far


def plausible(best: Attempt, demand: Demand, local: LocalMap, settings: MatchSettings) -> bool:
    """Whether enough of the scan fits the map, with a small enough free-space violation."""
    if best.share < demand.ways[-1][0]:
        return False
    if best.share <= SURE or demand is settings.far:
        against = best.against(local)
        if not any(best.share >= share and against <= most for share, most in demand.ways):
            return False
    return demand.held == 0.0 or held(best, local, settings) >= demand.held


def held(best: Attempt, local: LocalMap, settings: MatchSettings) -> float:
    """Share of the visible surfaces that fit the map, in the known direction where it is smallest.

    After a shift along a wall, most of a scan's points still fit that wall. Only the few points on surfaces across it
    reveal the error. Directions with hardly any visible surface count as fitting.
    """
    known = known_axes(best.H)
    if known[0] == known[1] == 0.0:
        return 1.0
    out = np.empty((2, 3))
    T = best.T - np.array((local.axis.centre[0], local.axis.centre[1], 0.0))
    icp.see_across(best.view.points, reference_of(local), T, settings.scale * best.view.noise_m, out)
    (sxx, sxy, syy), (fxx, fxy, fyy) = (out + np.array((FEW, 0.0, FEW))).tolist()
    if known[0] == 0.0:
        return float(fyy / syy)
    if known[1] == 0.0:
        return float(fxx / sxx)
    # the smaller root of det(fitting - share * seen) = 0
    a, b, c = sxx * syy - sxy * sxy, fxx * syy + fyy * sxx - 2.0 * fxy * sxy, fxx * fyy - fxy * fxy
    return float((b - math.sqrt(max(0.0, b * b - 4.0 * a * c))) / (2.0 * a))


def known_axes(H: Array) -> Array:
    """1 for each of x, y, yaw that the information makes known, else 0.

    Known: it reduces sigma from 0.5 m and 10 deg to 10 cm and 2 deg.
    """
    x, y, yaw = invert3(H + VAGUE).diagonal().tolist()
    return np.array((float(x < 0.01), float(y < 0.01), float(yaw < 0.0012)))


def no_match(T_pred: Array, queries: int, reason: Reason) -> MatchResult:
    """Result without a match, with its reason."""
    return MatchResult(T_pred.copy(), np.zeros((3, 3)), 0, queries, 0, 0.0, np.zeros(3), np.zeros(3), reason)
