"""Matching one scan against the local map: the call, a second opinion where the first is in doubt, and the verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from estimator import icp, se2
from estimator.keyframe import Beams
from estimator.linear3 import invert3
from estimator.localmap import LocalMap, contradicted
from estimator.records import Array
from estimator.result import MatchResult, Reason

VAGUE = np.diag((4.0, 4.0, 33.0))
"""Information of a pose known to 0.5 m and 10 deg."""

FIRST, SECOND = 30, 20
"""Most iterations of a first attempt, and of the one that finishes a second opinion."""

FEW = 3.0
"""Points that a direction must be seen with before it can speak against a place."""

SURE = 0.8
"""Share of fitting beams beyond which a good prediction needs no further evidence."""


@dataclass(frozen=True, slots=True)
class MatchSettings:
    """Matching, in terms of the physics.

    Attributes:
        gate_m: farthest partner ever accepted. scale: final robust scale in units of the noise.
        settled: a step shorter than this share of its own standard deviation ends the iteration.
        min_points: fewest pairs that make a result.
        tracking, searching: ways to be believed, each the least share of the beams that must fit and the largest share
            of the evidence that may speak against it, in falling order: when the prediction was good, and when it was
            not (a wrong place can look half right).
        wide_m, wide_rad: deviations of the prediction beyond which it counts as not good.
        doubt_share: where fewer beams fit, the prediction is doubted. doubt_m, doubt_rad: its deviations are then taken
            to be at least these, and ``fan`` headings to either side are tried, ``fan_rad`` apart.
        coarse, dense: every how many points will do while the pose is far off, in scans of how many.
    """

    gate_m: float = 0.5
    scale: float = 2.5
    settled: float = 0.3
    min_points: int = 10
    tracking: tuple[tuple[float, float], ...] = ((0.35, 0.35),)
    searching: tuple[tuple[float, float], ...] = ((0.6, 0.03), (0.5, 0.01))
    held: float = 0.5
    wide_m: float = 0.15
    wide_rad: float = 0.1
    doubt_share: float = 0.6
    doubt_m: float = 0.3
    doubt_rad: float = 0.2
    fan: int = 3
    fan_rad: float = 0.14
    coarse: int = 4
    dense: int = 400


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """What is to be matched.

    Attributes:
        points: (n, 4) place and tangent in the base frame at the scan's end. T_base_lidar: mount.
        beams: the scan they came from, for what it says of free space. noise_m: range noise to reckon with.
    """

    points: Array
    T_base_lidar: Array
    beams: Beams
    noise_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """T1 of Eq. 14: the predicted pose in the odom frame and its information (3, 3)."""

    T: Array
    L: Array


Asked = tuple[View, LocalMap, Prior, int, MatchSettings]
"""What :func:`match` is asked with; whoever keeps it can have the match told again, iteration by iteration."""


@dataclass(slots=True, eq=False)
class Attempt:
    """Outcome of one run of iterations from one start.

    Attributes:
        T: pose. H: information of the laser. sums: of the last pass. points: queries.
        trace: (iterations, icp.TRACE), what each iteration saw and did; poses relative to the axis centre.
        view, prior: what was matched, and from where.
    """

    T: Array
    H: Array
    sums: Array
    iterations: int
    points: int
    trace: Array
    view: View
    prior: Prior

    @property
    def share(self) -> float:
        """Share of the beams that fit."""
        return float(self.sums[icp.INLIERS]) / max(self.points, 1)


def match(
    view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings, tried: list[Attempt] | None = None
) -> MatchResult:
    """Match a scan from its prediction in at most ``cap`` iterations, a second opinion included.

    Every attempt is added to ``tried``, if one asks: the first, the trials of the second opinion, its last.
    """
    tried = [] if tried is None else tried
    first = attempt(view, local, prior, min(cap, FIRST), settings)
    tried.append(first)
    result = verdict(first, view, local, prior, settings)
    left = cap - first.iterations
    if left < SECOND or (result.ok and first.share >= settings.doubt_share):
        return result
    second = second_opinion(local, prior, settings, tried)
    return replace(verdict(second, view, local, prior, settings), iterations=min(cap, second.iterations))


def attempt(view: View, local: LocalMap, prior: Prior, cap: int, settings: MatchSettings) -> Attempt:
    """Iterate from a prediction."""
    H, sums, trace = np.zeros((3, 3)), np.zeros(icp.SUMS), np.empty((cap, icp.TRACE))
    axis, noise = local.axis, view.noise_m
    coarse = settings.coarse if len(view.points) > settings.dense else 1
    tail = (cap, settings.gate_m, settings.scale * noise, noise, settings.settled, coarse)
    how = np.array((view.T_base_lidar[0], view.T_base_lidar[1], *tail))
    centre = np.array((axis.centre[0], axis.centre[1], 0.0))
    T = prior.T - centre
    n = icp.iterate(view.points, (axis.rows, axis.start, axis.rays, local.lines), T, prior.L, how, (H, sums, trace))
    return Attempt(T + centre, H, sums, n, len(view.points), trace[:n], view, prior)


def second_opinion(local: LocalMap, prior: Prior, settings: MatchSettings, tried: list[Attempt]) -> Attempt:
    """Doubt the prediction: look about it for the place and heading that fit best, on a few points; finish that one.

    ``tried`` ends with the first attempt, and gets the others.

    Iterations are counted by the points they took, so that what is said of the cost stays true.
    """
    first = tried[-1]
    view = first.view
    L = np.diag(np.minimum(np.diag(prior.L), (settings.doubt_m**-2, settings.doubt_m**-2, settings.doubt_rad**-2)))
    few = replace(view, points=np.ascontiguousarray(view.points[:: max(1, len(view.points) // 180)]))
    best, share, work = first, first.share + 0.05, 0
    for k in range(-settings.fan, settings.fan + 1):
        start = Prior(prior.T + np.array((0.0, 0.0, k * settings.fan_rad)), L)
        trial = attempt(few, local, start, 12, settings)
        tried.append(trial)
        work += trial.iterations * len(few.points)
        if trial.share > share:
            best, share = trial, trial.share
    if best is not first:
        best = attempt(view, local, Prior(best.T, L), SECOND, settings)
        tried.append(best)
        work += best.iterations * best.points
    better = best if best.share > first.share else first
    return replace(better, iterations=first.iterations + work // max(1, first.points))


def verdict(best: Attempt, view: View, local: LocalMap, prior: Prior, settings: MatchSettings) -> MatchResult:
    """Judge an attempt: whether it is a result, and why not."""
    sums, (x, y, yaw), (x1, y1, yaw1) = best.sums.tolist(), best.T.tolist(), prior.T.tolist()
    length2 = sums[icp.LENGTH2]
    T = np.array((x, y, se2.wrap(yaw)))
    correction = np.array((x - x1, y - y1, se2.wrap(yaw - yaw1)))
    if sums[icp.PAIRS] < settings.min_points:
        reason = Reason.TOO_FEW_PAIRS
    elif not plausible(best, T, correction, (view, local, prior), settings):
        reason = Reason.REJECTED
    elif sums[icp.SETTLED]:
        reason = Reason.CONVERGED
    else:
        reason = Reason.OSCILLATING if sums[icp.DAMPING] < 0.5 and length2 > 1.0 else Reason.ITERATION_CAP
    ok = reason in (Reason.CONVERGED, Reason.ITERATION_CAP)
    H = best.H / (1.0 + length2)
    return MatchResult(
        T_odom_base=T if ok else prior.T.copy(),
        information=H,
        inliers=int(sums[icp.INLIERS]),
        queries=best.points,
        iterations=best.iterations,
        residual_m=math.sqrt(sums[icp.SQUARES] / max(sums[icp.WEIGHTS], 1e-9)),
        known_axes=known_axes(H) if ok else np.zeros(3),
        correction=correction,
        reason=reason,
    )


def plausible(
    best: Attempt, T: Array, correction: Array, asked: tuple[View, LocalMap, Prior], settings: MatchSettings
) -> bool:
    """Whether enough of the scan fits the map there, and not too much of either speaks against the place."""
    view, local, prior = asked
    Lx, Ly, Lyaw = prior.L.diagonal().tolist()
    wide = 1.0 / Lx + 1.0 / Ly > settings.wide_m**2 or 1.0 / Lyaw > settings.wide_rad**2
    x, y, yaw = correction.tolist()
    surprise = x * x + y * y > settings.wide_m**2 or abs(yaw) > settings.wide_rad
    surprise = surprise and float(correction @ prior.L @ correction) > 25.0
    ways = settings.searching if wide or surprise else settings.tracking
    if best.share < ways[-1][0]:
        return False
    if best.share > SURE and ways is settings.tracking:
        return True
    against = contradicted(local, se2.compose(T, view.T_base_lidar), view.beams, view.noise_m)
    if not any(best.share >= share and against <= most for share, most in ways):
        return False
    return ways is settings.tracking or held(best, local, settings) >= settings.held


def held(best: Attempt, local: LocalMap, settings: MatchSettings) -> float:
    """Share of the surfaces seen that fit the map, in the direction where it is smallest of those that count as known.

    A scan that is shifted along a wall fits it as well as ever, with most of its points; what shows the error are the
    few that lie across. Directions in which hardly anything is seen count as fitting.
    """
    known = known_axes(best.H)
    if known[0] == known[1] == 0.0:
        return 1.0
    axis, out = local.axis, np.empty((2, 3))
    T = best.T - np.array((axis.centre[0], axis.centre[1], 0.0))
    reference = (axis.rows, axis.start, axis.rays, local.lines)
    icp.see_across(best.view.points, reference, T, settings.scale * best.view.noise_m, out)
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
