"""Where in the whole map a keyframe fits, without any idea of the pose: everywhere, or where light or a person says.

The scan is searched for by branch and bound in one field of all settled submaps; each place that comes out is matched
against the submaps that lie there and judged as a loop is: by the share of the beams that fit, by what speaks against
it, by rank and by residual. A place that has been found before is only matched again where odometry says that the
robot must be by now. What the answers come to over several keyframes is decided elsewhere (`relocalisation`).

All of this is work for the background job; nothing here reads or changes a state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from estimator.mapping.keyframe import Keyframe, Settled, points_of_frame
from estimator.mapping.loop_verification import LoopSettings
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.branch_and_bound import Around, Field, SearchSettings, field_of, search
from estimator.scan_matching.deskew import oriented
from estimator.scan_matching.local_map import LocalMap, contradicted
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, View, match

CELL_M, BLUR, CELLS = 0.1, 0.7, 6e6
"""Resolution of the field, its deviation in cells, and how many cells it may have before it is made coarser."""

HITS, NODES, POINTS = 24, 4_000_000, 120
"""Of the search: places at most, nodes at most, points of the scan."""

LEAST, RATIO = 0.45, 0.75
"""Least score of a place, and least share of the best one's. A scan scores 0.9 to 1 where it was taken (random places
of a simulated office); what people and moved furniture hide is left room for."""

AROUND, NEAR_M = 6, 10.0
"""Submaps that a place is matched with: so many at most, and the nearest, and none farther than that but one."""

WITNESSES: Final = 3
"""Of these, so many are asked whether they have looked through where the scan has points."""

GUESS: Final = np.diag((0.3**-2, 0.3**-2, 0.1**-2))
"""Information with which a match starts."""

SAME_M, SAME_RAD = 0.4, 0.2
"""Two places nearer than this are one; a match that ends farther from where it began has found another place."""

POSSIBLE: Final = 0.15
"""Share of the evidence that may speak against a place before it is ruled out; a loop has to be surer."""


class Verdict(Enum):
    """What a keyframe says of a place."""

    HOLDS = "it fits as a loop does"
    OPEN = "nothing rules it out"
    NO = "too much speaks against it"


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A settled submap and where it lies."""

    key: int
    T_map_submap: Array
    settled: Settled


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """All that is settled, to be searched; ``field`` in the map's frame."""

    pieces: tuple[Piece, ...]
    field: Field


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How a keyframe fits at a place.

    Attributes:
        T_map_keyframe: the place as matched. P: covariance, 3x3, axes of the map. share, against, residual_m: how well,
        as of `loop_verification.Found`. key: submap nearest to it, and the place in that one.
    """

    T_map_keyframe: Array
    P: Array
    share: float
    against: float
    residual_m: float
    key: int
    T_submap_keyframe: Array
    verdict: Verdict


@dataclass(frozen=True, slots=True, eq=False)
class Query:
    """What a look is asked.

    Attributes:
        frame: keyframe to look for. pieces: where. before: terrain of an earlier look.
        guesses: where it should be by what was found earlier: T_map_keyframe each.
        past: earlier keyframes, of which a new place has to be true as well unless something else says so (`outvoted`):
            they may have been taken in somebody's hands.
        search: whether new places are searched for. windows: where; everywhere if None. nodes: most that are opened.
        outvoted: whether something else says that the robot is in the windows, or at the guesses; see `fit`.
        firm: of each guess whether earlier looks do, from places far enough apart; none are if it is empty.
    """

    frame: Keyframe
    pieces: tuple[Piece, ...]
    before: Terrain | None
    guesses: tuple[Array, ...]
    past: tuple[Keyframe, ...]
    search: bool = True
    windows: tuple[Around, ...] | None = None
    nodes: int = NODES
    outvoted: bool = False
    firm: tuple[bool, ...] = ()


@dataclass(frozen=True, slots=True, eq=False)
class Looked:
    """What a look has found.

    Attributes:
        terrain: for the next one. guesses: a fit for each guess. fresh: further places, each with its fits in the past.
        complete: no place was left out: neither the cap on nodes nor that on places ended the search; None: there was
            none.
    """

    terrain: Terrain
    guesses: tuple[Fit, ...]
    fresh: tuple[tuple[Fit, tuple[Fit, ...]], ...]
    complete: bool | None
    nodes: int


def look(query: Query, settings: LoopSettings) -> Looked:
    """Look for a keyframe in the whole map."""
    terrain = terrain_of(query.pieces, query.before)
    view = view_of(query.frame, settings)
    firm = query.firm or (False,) * len(query.guesses)
    asked = zip(query.guesses, firm, strict=True)
    guesses = tuple(fit(view, terrain, T, settings, query.outvoted or held) for T, held in asked)
    if view is None or not query.search:
        return Looked(terrain, guesses, (), None, 0)
    hits, complete, nodes = searched(query, terrain, view)
    known = [one.T_map_keyframe for one in guesses]
    past = [(frame, view_of(frame, settings)) for frame in query.past] if hits else []
    fresh = []
    for T in hits:
        if any(same(T, other) for other in known):
            continue
        one = fit(view, terrain, T, settings, query.outvoted)
        if one.verdict is Verdict.NO or any(same(one.T_map_keyframe, other) for other in known):
            continue
        known.append(one.T_map_keyframe)
        earlier = []
        for frame, seen in past:
            T_back = se2.between(query.frame.T_odom_keyframe, frame.T_odom_keyframe)
            earlier.append(fit(seen, terrain, se2.compose(one.T_map_keyframe, T_back), settings, query.outvoted))
        if query.outvoted or all(other.verdict is not Verdict.NO for other in earlier):
            fresh.append((one, tuple(earlier)))
    return Looked(terrain, guesses, tuple(fresh), complete, nodes)


def terrain_of(pieces: tuple[Piece, ...], before: Terrain | None) -> Terrain:
    """The terrain of these submaps; the same one as before where nothing has come, gone or moved."""
    if before is not None and len(before.pieces) == len(pieces):
        pairs = zip(before.pieces, pieces, strict=True)
        if all(a.settled is b.settled and np.array_equal(a.T_map_submap, b.T_map_submap) for a, b in pairs):
            return before
    points = np.vstack([placed(piece)[:, :2] for piece in pieces])
    width, height = np.ptp(points, axis=0) + 2.0
    cell = max(CELL_M, math.sqrt(float(width * height) / CELLS))
    return Terrain(pieces, field_of(points, cell, BLUR * cell, 1.0))


def placed(piece: Piece) -> Array:
    """The elements of a submap in the map's frame."""
    elements = piece.settled.elements.astype(np.float64)
    R = se2.rotation(piece.T_map_submap[2])[:2, :2]
    elements[:, :2] = se2.apply(piece.T_map_submap, elements[:, :2])
    elements[:, 2:4] = elements[:, 2:4] @ R.T
    return elements


def view_of(frame: Keyframe, settings: LoopSettings) -> View | None:
    """A keyframe as something to match; None where it has seen too little."""
    points = points_of_frame(frame, 0.01)
    if len(points.xy) < MatchSettings().min_points:
        return None
    return View(oriented(points, settings.points), frame.T_base_lidar, frame.beams(), 0.01)


def searched(query: Query, terrain: Terrain, view: View) -> tuple[list[Array], bool, int]:
    """Places (T_map_keyframe) where the scan fits best, whether they are all there are, nodes opened."""
    frame = query.frame
    lidar_base = se2.inverse(frame.T_base_lidar)
    seen = se2.apply(lidar_base, points_of_frame(frame, view.noise_m).xy)
    around: Sequence[Around | None] = (None,) if query.windows is None else query.windows
    hits: list[Array] = []
    complete, nodes = True, 0
    for window in around:
        asked = SearchSettings(LEAST, RATIO, HITS, query.nodes - nodes, points=POINTS, around=window)
        found = search(terrain.field, seen, asked)
        hits += [se2.compose(hit.T_map_lidar, lidar_base) for hit in found.hits]
        complete &= found.complete and len(found.hits) < HITS
        nodes += found.nodes
    return hits, complete, nodes


def same(T: Array, other: Array) -> bool:
    """Whether two places are one."""
    x, y, yaw = se2.between(T, other).tolist()
    return math.hypot(x, y) < SAME_M and abs(yaw) < SAME_RAD


def fit(view: View | None, terrain: Terrain, T: Array, settings: LoopSettings, outvoted: bool = False) -> Fit:
    """Match a scan at a place of the map, and judge it.

    ``outvoted``: something else says that it is here or nearby (light, a person, earlier looks). Then a single witness
    that has looked through where the scan has points does not rule the place out: a door that stood open then is shut.
    """
    near = nearest(terrain, T)
    piece = terrain.pieces[near[0]]
    if view is None:
        return Fit(T, np.eye(3), 0.0, 0.0, 0.0, piece.key, se2.between(piece.T_map_submap, T), Verdict.OPEN)
    local = local_of(terrain, near, T)
    result = match(view, local, Prior(T, GUESS), 60, MatchSettings())
    T_found = result.T_odom_base  # the prediction where the match is none
    against, second = worst(terrain, near, local, T_found, view)
    share = result.inliers / max(1, result.queries) if result.ok else 0.0
    extra = np.diag((settings.extra_m**2, settings.extra_m**2, settings.extra_rad**2))
    P = invert3(result.information) + extra if result.ok else np.eye(3)
    verdict = judged(result, share, against, settings) if same(T, T_found) else Verdict.NO
    if outvoted and against > POSSIBLE >= second and result.ok and same(T, T_found):
        verdict = Verdict.OPEN
    T_submap_keyframe = se2.between(piece.T_map_submap, T_found)
    return Fit(T_found, P, share, against, result.residual_m, piece.key, T_submap_keyframe, verdict)


def judged(result: MatchResult, share: float, against: float, settings: LoopSettings) -> Verdict:
    """What a match says of its place."""
    if against > POSSIBLE:
        return Verdict.NO
    sure = result.ok and share >= settings.share and against <= settings.against and result.residual_m <= settings.sse_m
    return Verdict.HOLDS if sure and result.known_axes.all() else Verdict.OPEN


def nearest(terrain: Terrain, T: Array) -> list[int]:
    """Numbers of the pieces that lie about a place, nearest first; at least one."""
    away = [math.hypot(*(piece.T_map_submap[:2] - T[:2]).tolist()) for piece in terrain.pieces]
    order = sorted(range(len(away)), key=lambda k: (away[k], k))
    return [k for n, k in enumerate(order[:AROUND]) if n == 0 or away[k] < NEAR_M]


def local_of(terrain: Terrain, near: Sequence[int], T: Array) -> LocalMap:
    """The pieces as one map to match against, in the map's frame."""
    return local_map.index(np.vstack([placed(terrain.pieces[k]) for k in near]), T[:2], 1, None)


def worst(terrain: Terrain, near: Sequence[int], local: LocalMap, T: Array, view: View) -> tuple[float, float]:
    """The two largest shares of the evidence against a place that the map or one of its witnesses knows of."""
    eye = se2.compose(T, view.T_base_lidar)
    shares = [0.0, contradicted(local, eye, view.beams, view.noise_m)]
    for k in near[:WITNESSES]:
        piece = terrain.pieces[k]
        T_submap_eye = se2.between(piece.T_map_submap, eye)
        empty = local_map.empty(np.zeros(2))
        empty.newest = piece.settled.witness
        shares.append(contradicted(empty, T_submap_eye, view.beams, view.noise_m))
    second, most = sorted(shares)[-2:]
    return most, second
