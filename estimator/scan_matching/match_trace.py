"""One match told again, iteration by iteration: its pairs, their residuals and weights, and what light says beside it.

A match keeps a trace of a few numbers an iteration. Everything else follows from it and from what the matcher was asked
with, because the kernels are deterministic; so a match costs nothing until somebody asks, and what is then told is what
happened. Loaded by those who ask only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.fusion import map_odom_filter
from estimator.measurements import Array, Scan
from estimator.numerics import se2
from estimator.result import Fix, MatchResult
from estimator.scan_matching import icp, scan_matcher
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.local_map import LocalMap
from estimator.scan_matching.scan_matcher import Asked, Attempt
from estimator.state import State

Ints = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The pairs of one iteration that have spoken, one row each.

    Attributes:
        point: index of the query in the attempt's points. element: index in the local map's elements.
        residual_m: signed distance of the point from its partner, along the partner's normal (towards the sensor).
        weight: robust weight, 0 to 1. square: its share of the iteration's sum of squares, m^2.
        fits: it counts among the inliers.
    """

    point: Ints
    element: Ints
    residual_m: Array
    weight: Array
    square: Array
    fits: npt.NDArray[np.bool_]


@dataclass(frozen=True, slots=True, eq=False)
class Iteration:
    """One iteration: the pose T_odom_base it began at, its row of the trace (`icp.TRACE` columns), its pairs."""

    T_odom_base: Array
    row: Array
    pairs: Pairs


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """One attempt told again: ``what`` is "first", "trial" or "final" (the last two of a second opinion)."""

    what: str
    attempt: Attempt
    iterations: tuple[Iteration, ...]


@dataclass(frozen=True, slots=True, eq=False)
class LightPoint:
    """One lamp as a point of the paper's Eq. 13: its place in body frames, which light alone has told.

    Attributes:
        reference: in the frame of the newest keyframe, ``X_ref^-1 L``; None if light said nothing good there.
        present: in the present body frame, ``X_new^-1 L``.
        residual: how far the matched motion since the keyframe carries ``present`` from ``reference`` (x, y in m, frame
            of the keyframe); None without a reference or a match.
        logarithm: of received over expected strength in the latest epoch, None if it was not received.
    """

    lamp_id: int
    code: int
    reference: Array | None
    present: Array
    residual: Array | None
    logarithm: float | None


@dataclass(frozen=True, slots=True, eq=False)
class LightSaid:
    """What light said at a scan: how far its fix had come, the pose T_map_base if it was good, and the lamps in use.

    ``keyframe`` is the ID of the newest one, laid at ``T_odom_keyframe``.
    """

    fix: Fix
    T_map_base: Array | None
    keyframe: int
    T_odom_keyframe: Array
    lamps: tuple[LightPoint, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Entry:
    """One match as it was asked and answered, and what light said; a few references, nothing computed yet."""

    scan: Scan
    points: ScanPoints
    asked: Asked | None
    result: MatchResult
    light: LightSaid | None


def entry_of(state: State, scan: Scan, points: ScanPoints, asked: Asked | None, result: MatchResult) -> Entry:
    """Keep a match, from within `State.journal`: after the match and before it is fused."""
    return Entry(scan, points, asked, result, light_said(state, result))


def tell(entry: Entry) -> tuple[Told, ...]:
    """Match again and tell every attempt; nothing where the matcher was not asked (no map, too few points)."""
    if entry.asked is None:
        return ()
    view, local, prior, cap, settings = entry.asked
    tried: list[Attempt] = []
    scan_matcher.match(view, local, prior, cap, settings, tried)
    names = [name_of(k, attempt, view) for k, attempt in enumerate(tried)]
    return tuple(Told(name, a, iterations_of(a, local)) for name, a in zip(names, tried, strict=True))


def name_of(number: int, attempt: Attempt, view: scan_matcher.View) -> str:
    """What an attempt was for: a second opinion's trials take few of the points, its last one all of them."""
    if number == 0:
        return "first"
    return "final" if attempt.view is view else "trial"


def iterations_of(attempt: Attempt, local: LocalMap) -> tuple[Iteration, ...]:
    """The iterations of an attempt, with their pairs, in order."""
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
    """What each pair adds to the sums of the iteration that left this row of the trace.

    The matcher's own kernel is asked for one pair at a time, so that no second form of the model can differ from it.
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


def light_said(state: State, match: MatchResult) -> LightSaid | None:
    """What light said at this scan; None where there is no photodiode."""
    if state.light is None:
        return None
    light, virtual = state.light, map_odom_filter.virtual(state)
    if virtual is None:
        return LightSaid(light.result.fix, None, state.anchor, state.T_odom_anchor, ())
    newest = state.keyframes.get(state.anchor)
    before = None if newest is None else newest.virtual
    moved = se2.between(state.T_odom_anchor, match.T_odom_base) if match.ok else None
    strength = {link.lamp_id: link.residual for link in light.result.links}
    lamps = []
    for lamp_id in sorted(virtual.accepted | (frozenset() if before is None else before.accepted)):
        lamp = light.filter.catalogue.by_id.get(lamp_id)
        if lamp is None:
            continue
        at = np.array(((lamp.x, lamp.y),))
        present = se2.apply(se2.inverse(virtual.T_map_base), at)[0]
        reference = None if before is None else se2.apply(se2.inverse(before.T_map_base), at)[0]
        residual = None
        if reference is not None and moved is not None:
            residual = se2.apply(moved, present[None])[0] - reference
        lamps.append(LightPoint(lamp_id, lamp.code, reference, present, residual, strength.get(lamp_id)))
    return LightSaid(light.result.fix, virtual.T_map_base, state.anchor, state.T_odom_anchor, tuple(lamps))
