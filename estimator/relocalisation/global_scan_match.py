"""Global scan match: poses of a keyframe in the whole map without a prediction, or in given search windows.

Branch and bound searches the scan in one likelihood field of all finished submaps. Each hit is matched against the
submaps around it and judged like a loop: by inlier share, free-space violation, rank and residual. A pose found before
is only matched again where odometry predicts it now. `relocalisation` combines the results of several keyframes.

All of this runs in a background job; nothing here reads or changes the state.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Final

import numpy as np

from estimator.job_queue import job_function
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
"""Resolution of the field (m), its sigma in cells, and most cells before the resolution becomes coarser."""

HITS, NODES, POINTS = 24, 4_000_000, 120
"""Limits of the search: hits, nodes, points of the scan."""

LEAST, RATIO = 0.45, 0.75
"""Smallest score of a hit, and smallest share of the best one's score.

A scan scores 0.9 to 1 at its own pose (random poses in a simulated office). The rest allows for people and moved
furniture.
"""

AROUND, NEAR_M = 6, 10.0
"""Most submaps matched at a hit, nearest first, and their largest distance (m); one is always used."""

WITNESSES: Final = 3
"""Number of these whose reference scan takes part in the free-space test."""

FIT_NODES: Final = 10_000
"""Nodes that take as long as one match: 0.5 us and 5 ms on one core of 2.5 GHz."""

GUESS: Final = np.diag((0.3**-2, 0.3**-2, 0.1**-2))
"""Initial information of a match."""

SAME_M, SAME_RAD = 0.4, 0.2
"""Distance (m, rad) of one and the same pose; a match that ends farther from its start has found another one."""

POSSIBLE: Final = 0.15
"""Free-space violation above which a pose is excluded; a loop has a stricter threshold."""


class Verdict(Enum):
    """Result of a keyframe at a pose."""

    HOLDS = "it fits as a loop does"
    OPEN = "nothing rules it out"
    NO = "too much speaks against it"


@dataclass(frozen=True, slots=True, eq=False)
class Piece:
    """A finished submap with its pose."""

    key: int
    T_map_submap: Array
    settled: Settled


@dataclass(frozen=True, slots=True, eq=False)
class Terrain:
    """The search map: all finished submaps; ``field`` in the map frame."""

    pieces: tuple[Piece, ...]
    field: Field


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """Match of a keyframe at a pose.

    Attributes:
        T_map_keyframe: the matched pose.
        P: covariance, 3x3, axes of the map.
        share, against, residual_m: quality, as of `loop_verification.Found`.
        key, T_submap_keyframe: nearest submap, and the pose in its frame.
        verdict: result.
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
    """Input of a search.

    Attributes:
        frame: keyframe to search.
        pieces: submaps to search in.
        before: search map of an earlier search.
        guesses: expected pose T_map_keyframe of each hypothesis.
        past: earlier keyframes that a new pose has to fit as well, unless another sensor confirms it (`outvoted`): they
            may date from before the robot was put down.
        search: whether to search new poses.
        windows: search windows; everywhere if None.
        nodes: most nodes opened.
        outvoted: whether another source places the robot in the windows, or at the guesses; see `fit`.
        firm: for each guess whether earlier searches confirm it, from positions far enough apart; none do if it is
            empty.
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
    """Result of a search.

    Attributes:
        terrain: search map for the next one.
        guesses: a fit for each guess.
        fresh: further poses, each with its fits in the past.
        complete: neither the cap on nodes nor that on hits ended the search; None: there was no search.
        nodes: number of nodes opened.
        fits: number of matches.
    """

    terrain: Terrain
    guesses: tuple[Fit, ...]
    fresh: tuple[tuple[Fit, tuple[Fit, ...]], ...]
    complete: bool | None
    nodes: int
    fits: int = 0

    def work(self) -> float:
        """Work of the search in nodes: its cost on any computer, the same in every replay."""
        return self.nodes + FIT_NODES * self.fits


@job_function
def look(query: Query, settings: LoopSettings) -> Looked:
    """Search a keyframe in the whole map."""
    terrain = terrain_of(query.pieces, query.before)
    view = view_of(query.frame, settings)
    firm = query.firm or (False,) * len(query.guesses)
    asked = zip(query.guesses, firm, strict=True)
    guesses = tuple(fit(view, terrain, T, settings, query.outvoted or held) for T, held in asked)
    if view is None or not query.search:
        return Looked(terrain, guesses, (), None, 0, len(guesses))
    hits, complete, nodes = searched(query, terrain, view)
    known = [one.T_map_keyframe for one in guesses]
    past = [(frame, view_of(frame, settings)) for frame in query.past] if hits else []
    fresh, fits = [], len(guesses)
    for T in hits:
        if any(same(T, other) for other in known):
            continue
        one, fits = fit(view, terrain, T, settings, query.outvoted), fits + 1 + len(past)
        if one.verdict is Verdict.NO or any(same(one.T_map_keyframe, other) for other in known):
            continue
        known.append(one.T_map_keyframe)
        earlier = []
        for frame, seen in past:
            T_back = se2.between(query.frame.T_odom_keyframe, frame.T_odom_keyframe)
            earlier.append(fit(seen, terrain, se2.compose(one.T_map_keyframe, T_back), settings, query.outvoted))
        if query.outvoted or all(other.verdict is not Verdict.NO for other in earlier):
            fresh.append((one, tuple(earlier)))
    return Looked(terrain, guesses, tuple(fresh), complete, nodes, fits)


def terrain_of(pieces: tuple[Piece, ...], before: Terrain | None) -> Terrain:
    """Search map of these submaps; the earlier one where no submap was added, removed or moved."""
    if before is not None and len(before.pieces) == len(pieces):
        pairs = zip(before.pieces, pieces, strict=True)
        if all(a.settled is b.settled and np.array_equal(a.T_map_submap, b.T_map_submap) for a, b in pairs):
            return before
    points = np.vstack([placed(piece)[:, :2] for piece in pieces])
    width, height = np.ptp(points, axis=0) + 2.0
    cell = max(CELL_M, math.sqrt(float(width * height) / CELLS))
    return Terrain(pieces, field_of(points, cell, BLUR * cell, 1.0))


def placed(piece: Piece) -> Array:
    """The elements of a submap in the map frame."""
    elements = piece.settled.elements.astype(np.float64)
    R = se2.rotation(piece.T_map_submap[2])[:2, :2]
    elements[:, :2] = se2.apply(piece.T_map_submap, elements[:, :2])
    elements[:, 2:4] = elements[:, 2:4] @ R.T
    return elements


def view_of(frame: Keyframe, settings: LoopSettings) -> View | None:
    """A keyframe as match input; None with too few points."""
    points = points_of_frame(frame, 0.01)
    if len(points.xy) < MatchSettings().min_points:
        return None
    return View(oriented(points, settings.points), frame.T_base_lidar, frame.beams(), 0.01)


def searched(query: Query, terrain: Terrain, view: View) -> tuple[list[Array], bool, int]:
    """Poses (T_map_keyframe) where the scan fits best, whether they are complete, and the nodes opened."""
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
    """Whether two poses are one."""
    x, y, yaw = se2.between(T, other).tolist()
    return math.hypot(x, y) < SAME_M and abs(yaw) < SAME_RAD


def fit(view: View | None, terrain: Terrain, T: Array, settings: LoopSettings, outvoted: bool = False) -> Fit:
    """Match a scan at a pose of the map, and judge it.

    ``outvoted``: another source supports this pose (light, an operator, earlier searches). Then a single reference scan
    with free-space violation does not exclude it: a door that was open then is shut now.
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
    """Verdict of a match on its pose."""
    if against > POSSIBLE:
        return Verdict.NO
    sure = result.ok and share >= settings.share and against <= settings.against and result.residual_m <= settings.sse_m
    return Verdict.HOLDS if sure and result.known_axes.all() else Verdict.OPEN


def nearest(terrain: Terrain, T: Array) -> list[int]:
    """Indices of the submaps around a pose, nearest first; at least one."""
    away = [math.hypot(*(piece.T_map_submap[:2] - T[:2]).tolist()) for piece in terrain.pieces]
    order = sorted(range(len(away)), key=lambda k: (away[k], k))
    return [k for n, k in enumerate(order[:AROUND]) if n == 0 or away[k] < NEAR_M]


def local_of(terrain: Terrain, near: Sequence[int], T: Array) -> LocalMap:
    """The submaps as one local map, in the map frame."""
    return local_map.index(np.vstack([placed(terrain.pieces[k]) for k in near]), T[:2], 1, None)


def worst(terrain: Terrain, near: Sequence[int], local: LocalMap, T: Array, view: View) -> tuple[float, float]:
    """The largest and second largest free-space violation among the map and its reference scans."""
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
