"""Matching one scan against the local map: the call, a second opinion where the first is in doubt, and the verdict."""

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
"""Most iterations of a first attempt and of a trial of the second opinion; iterations kept for the attempt that
finishes it; fewer than the last are too few to begin one."""

SURE = 0.8
"""Share of fitting beams beyond which no evidence against a place is looked for, unless it is far away."""

FEW = 3.0
"""Points that a direction must be seen with before it can speak against a place."""

CLAIM = 1.15
"""What an information matrix is worth in truth: a Cauchy weight counts a Gaussian residual 0.89 times, but costs only
0.04 of what it knows; and surfaces met at a grazing angle are trusted less than an ideal beam would deserve."""


@dataclass(frozen=True, slots=True)
class Demand:
    """What a place must show to be believed.

    Attributes:
        ways: each the least share of the beams that must fit and the largest share of the evidence that may speak
            against it, in falling order. held: the least, see :func:`held`.
    """

    ways: tuple[tuple[float, float], ...]
    held: float = 0.0


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Matching, in terms of the physics.

    Attributes:
        gate_m: farthest partner ever accepted. scale: final robust scale in units of the noise.
        settled: a step shorter than this share of its own standard deviation ends the iteration.
        min_points: fewest pairs that make a result.
        tracking, near, far: what is asked when the prediction was good; when it was vague, of a place within ``near_m``
            and ``near_rad`` of it; and of one farther away, or where it was wrong (a wrong place can look half right).
        wide_m, wide_rad: deviations of the prediction beyond which it counts as not good.
        doubt_share, doubt_against: where fewer beams fit and more speaks against the place, another is looked for.
        doubt_m, doubt_rad: deviations of the prediction are then taken to be at least these. ``fan`` headings to either
            side are tried, ``fan_rad`` apart, then places ``shift_m`` away, on at most ``few`` points.
        coarse, dense: every how many points will do while the pose is far off, in scans of how many.
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
    """What is to be matched.

    Attributes:
        points: (n, 4) place and tangent in the base frame at the scan's end. T_base_lidar: mount. beams: the scan they
        came from, for what it says of free space. noise_m: range noise to reckon with. alike: how many beams tell as
        much as one of them would, were their errors independent (`estimator.scan_matching.residual_correlation`).
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
"""What :func:`match` is asked with; whoever keeps it can have the match told again, iteration by iteration."""


class ScanMatcher(Protocol):
    """Matches one scan with the local map, or with its newest keyframe; :func:`match` is the default."""

    def __call__(self, view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, /) -> MatchResult:
        """Match a scan from its prediction in at most ``cap`` iterations."""


@dataclass(slots=True, eq=False)
class Attempt:
    """Outcome of one run of iterations from one start.

    Attributes:
        T: pose. H: information of the laser. sums: of the last pass. points: queries.
        trace: (iterations, icp.TRACE), what each iteration saw and did; poses relative to the axis centre.
        view, prior: what was matched, and from where. contradicted: see :meth:`against`, None before that is asked.
        demand: what was asked of it, None before a verdict.
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
        """Share of the beams that fit."""
        return float(self.sums[icp.INLIERS]) / max(self.points, 1)

    def against(self, local: LocalMap) -> float:
        """Share of the evidence that speaks against the place; looked up once."""
        if self.contradicted is None:
            at = se2.compose(self.T, self.view.T_base_lidar)
            self.contradicted = contradicted(local, at, self.view.beams, self.view.noise_m)
        return self.contradicted

    def score(self, local: LocalMap) -> float:
        """How well a place fits, to be compared with others for the same scan."""
        return self.share - 2.0 * self.against(local)

    def fits(self, local: LocalMap, settings: MatchSettings) -> bool:
        """Whether a place fits so well that no other need be looked for."""
        return self.share > SURE and self.against(local) <= settings.doubt_against


def match(
    view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, tried: list[Attempt] | None = None
) -> MatchResult:
    """Match a scan from its prediction in at most ``cap`` iterations, a second opinion included.

    Every attempt is added to ``tried``, if one asks: the first, the trials of the second opinion, its last.
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
    """The map as the kernels take it."""
    return local.axis.rows, local.axis.start, local.axis.rays, local.lines


def attempt(view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings) -> Attempt:
    """Iterate from a prediction."""
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
    """Whether another place might fit better: it is no result, or much does not fit and some speaks against it."""
    if not result.ok:
        return True
    least = settings.doubt_share if first.demand is settings.tracking else SURE
    return first.share < least and first.against(local) > settings.doubt_against


def second_opinion(
    local: LocalMap, prior: Prior, settings: MatchSettings, tried: list[Attempt], budget: int
) -> tuple[Attempt, int]:
    """Doubt the prediction: look about it for the place and heading that fit best, on a few points; finish that one.

    ``tried`` ends with the first attempt, and gets the others. ``budget``: points that may be passed over in all
    iterations, of which a share is kept for the last. Returns the better of first and last, and the points passed over.
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
    """Information of a prediction that has turned out to be worse than it said."""
    most = settings.doubt_m**-2, settings.doubt_m**-2, settings.doubt_rad**-2
    return np.diag(np.minimum(np.diag(prior.L), most))


def starts(prior: Prior, tried: list[Attempt], settings: MatchSettings) -> Iterator[Prior]:
    """Where to look again: headings to either side of the prediction; then places around it, with the best heading."""
    L = doubted(prior, settings)
    for k in sorted(range(-settings.fan, settings.fan + 1), key=abs):
        yield Prior(prior.T + np.array((0.0, 0.0, k * settings.fan_rad)), L)
    yaw = max(tried, key=lambda trial: trial.share).T[2]
    for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        yield Prior(np.array((prior.T[0] + x * settings.shift_m, prior.T[1] + y * settings.shift_m, yaw)), L)


def verdict(best: Attempt, local: LocalMap, prior: Prior, settings: MatchSettings) -> MatchResult:
    """Judge an attempt: whether it is a result, and why not."""
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
    """What is asked of a place: more if the prediction was vague or wrong, and most if it is far from it, too."""
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
    """Whether enough of the scan fits the map there, and not too much of either speaks against the place."""
    if best.share < demand.ways[-1][0]:
        return False
    if best.share <= SURE or demand is settings.far:
        against = best.against(local)
        if not any(best.share >= share and against <= most for share, most in demand.ways):
            return False
    return demand.held == 0.0 or held(best, local, settings) >= demand.held


def held(best: Attempt, local: LocalMap, settings: MatchSettings) -> float:
    """Share of the surfaces seen that fit the map, in the direction where it is smallest of those that count as known.

    A scan that is shifted along a wall fits it as well as ever, with most of its points; what shows the error are the
    few that lie across. Directions in which hardly anything is seen count as fitting.
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
    # the lesser root of det(fitting - share * seen) = 0
    a, b, c = sxx * syy - sxy * sxy, fxx * syy + fyy * sxx - 2.0 * fxy * sxy, fxx * fyy - fxy * fxy
    return float((b - math.sqrt(max(0.0, b * b - 4.0 * a * c))) / (2.0 * a))


def known_axes(H: Array) -> Array:
    """1 for each of x, y, yaw that the information brings from 0.5 m and 10 deg to 10 cm and 2 deg, else 0."""
    x, y, yaw = invert3(H + VAGUE).diagonal().tolist()
    return np.array((float(x < 0.01), float(y < 0.01), float(yaw < 0.0012)))


def no_match(T_pred: Array, queries: int, reason: Reason) -> MatchResult:
    """A match that did not take place, and why."""
    return MatchResult(T_pred.copy(), np.zeros((3, 3)), 0, queries, 0, 0.0, np.zeros(3), np.zeros(3), reason)
