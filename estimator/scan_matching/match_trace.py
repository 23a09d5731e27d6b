"""Repeats one match with a full trace, for plots: pairs, residuals and weights of each iteration.

A match keeps a trace of a few numbers an iteration. The kernels are deterministic, so everything else follows from that
trace and the arguments of the match. A match itself therefore spends no time on it, and the trace shows what happened.
Only plots and tests import this module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.numerics import se2
from estimator.numerics.arrays import Array, Ints
from estimator.scan_matching import icp, scan_matcher
from estimator.scan_matching.local_map import LocalMap
from estimator.scan_matching.scan_matcher import Asked, Attempt


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The pairs that counted in one iteration, one row each.

    Attributes:
        point: index of the query in the attempt's points.
        element: index in the local map's elements.
        residual_m: signed distance of the point from its partner, along the partner's normal (towards the sensor).
        weight: robust weight, 0 to 1.
        square: its share of the iteration's sum of squares, m^2.
        fits: whether it is an inlier.
    """

    point: Ints
    element: Ints
    residual_m: Array
    weight: Array
    square: Array
    fits: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Iteration:
    """One iteration: its initial pose T_odom_base, its row of the trace (`icp.TRACE` columns), its pairs."""

    T_odom_base: Array
    row: Array
    pairs: Pairs


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """One repeated attempt: ``what`` is "first", "trial" or "final" (the last two belong to a multi-start)."""

    what: str
    attempt: Attempt
    iterations: tuple[Iteration, ...]


def tell(asked: Asked | None) -> tuple[Told, ...]:
    """Repeat a match and return all attempts; empty where no matcher ran (no map, too few points)."""
    if asked is None:
        return ()
    view, local, prior, cap, settings = asked
    tried: list[Attempt] = []
    scan_matcher.match(view, local, prior, cap, settings, tried)
    names = [name_of(k, attempt, view) for k, attempt in enumerate(tried)]
    return tuple(Told(name, a, iterations_of(a, local)) for name, a in zip(names, tried, strict=True))


def name_of(number: int, attempt: Attempt, view: scan_matcher.View) -> str:
    """Name of an attempt: "first"; in a multi-start a "trial" uses few of the points, the "final" one all of them."""
    if number == 0:
        return "first"
    return "final" if attempt.view is view else "trial"


def iterations_of(attempt: Attempt, local: LocalMap) -> tuple[Iteration, ...]:
    """The iterations of an attempt with their pairs, in order."""
    axis, view = local.axis, attempt.view
    reference = (axis.rows, axis.start, axis.rays, local.lines)
    centre = np.array((axis.centre[0], axis.centre[1], 0.0))
    body = np.empty((6, len(view.points)))
    icp.lay_out(view.points, view.T_base_lidar[0], view.T_base_lidar[1], 1, body)
    told = []
    for row in attempt.trace:
        partner = icp.paired(view.points, reference, row)
        pairs = pairs_at(body, (local, partner), row)
        told.append(Iteration(row[: icp.AT_YAW + 1] + centre, row, pairs))
    return tuple(told)


def pairs_at(body: Array, partners: tuple[LocalMap, Ints], trace: Array) -> Pairs:
    """Contribution of each pair to the sums of the iteration that produced this row of the trace.

    The matcher's own kernel runs for one pair at a time, so that no second implementation can differ from it.
    """
    local, partner = partners
    T, scale = trace[: icp.AT_YAW + 1].copy(), trace[icp.SCALE]
    queries = np.flatnonzero(partner >= 0)
    sums, said = np.zeros(icp.SUMS), np.empty((len(queries), 4))
    one, held = np.empty((6, 1)), np.zeros((5, 1))
    for k, i in enumerate(queries.tolist()):
        one[:, 0] = body[:, i]
        icp.hold(local.axis.rows, local.lines, partner[i], 0, held)
        icp.sum_up(one, held, T, scale, 1, sums)
        said[k] = sums[icp.PAIRS], sums[icp.WEIGHTS], sums[icp.SQUARES], sums[icp.INLIERS]
    taken = said[:, 0] > 0.0
    queries, said = queries[taken], said[taken]
    row = partner[queries]
    away = se2.apply(T, body[:2, queries].T) - local.axis.rows[row, :2]
    residual = (local.lines[row, :2] * away).sum(axis=1)
    return Pairs(queries, local.axis.label[row], residual, said[:, 1], said[:, 2], said[:, 3] > 0.0)
