"""An old map of many submaps, of which a graph is to be solved."""

from itertools import pairwise
from typing import Final

import numpy as np

from estimator.mapping.keyframe import Settled, Submap
from estimator.numerics import se2
from estimator.state import State

SUBMAPS: Final = 1000
STEP_M: Final = 3.0
ROW: Final = 20
"""Submaps in a row of the serpentine that the old map is."""
NOISE: Final = np.array((0.02, 0.02, 0.004))


def old_map(state: State, count: int, settled: Settled | None = None, seed: int = 0) -> None:
    """Lay ``count`` submaps up and down a hall, rows joined by loops, that end where the robot starts."""
    rng, atlas, P = np.random.default_rng(seed), state.map.graph, np.diag(NOISE**2)
    turn = [np.pi / 2 * (1 if (k // ROW) % 2 == 0 else -1) if k % ROW >= ROW - 2 else 0.0 for k in range(count)]
    truth = [np.array((100.0, 0.0, 0.0))]
    for k in range(count - 1):
        truth.append(se2.compose(truth[-1], np.array((STEP_M, 0.0, turn[k]))))
    home = np.array((60.0, 60.0, 0.0))
    place = [se2.compose(home, se2.between(truth[-1], T)) for T in truth]
    place[-1] = se2.identity()
    way = [se2.compose(se2.between(a, b), NOISE * rng.standard_normal(3)) for a, b in pairwise(place)]
    laid = [se2.identity()]
    for T in reversed(way):
        laid.append(se2.compose(laid[-1], se2.inverse(T)))
    for k, T in enumerate(reversed(laid)):
        atlas.submaps[k + 1] = Submap(k + 1, -count + k, T, T, STEP_M * (k - count) - 100.0, settled)
        if k:
            atlas.constraints.add(k, k + 1, way[k - 1], P, False)
    for k in range(ROW, count - 1, 3):
        near = int(np.argmin([np.hypot(*(place[i] - place[k])[:2]) for i in range(k - ROW // 2)]))
        T = se2.compose(se2.between(place[near], place[k]), NOISE * rng.standard_normal(3))
        if np.hypot(*T[:2]) < 2.5 * STEP_M:
            atlas.constraints.add(near + 1, k + 1, T, P, True)
    atlas.stale = True
