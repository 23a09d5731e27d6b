"""How surely a stored or left map lies in the survey's frame at one of its places.

What the pose knew when the map was left says much of that place and little of one far away: a heading that is sure to
2 deg swings by half a metre over 15 m. But light has told the place of nearly every submap, and the pose graph has
weighed all that. So the map as a whole lies as surely as all of them together say, each carried here.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.mapping.keyframe import Submap
from estimator.mapping.relative_covariance import inverse3
from estimator.mapping.submap_graph import Atlas
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.numerics.symmetric3 import invert3, swing

APART: Final = 4.0
"""By how much the variance of what light said is raised: its errors hang together over several submaps."""

BENT: Final = np.diag((0.1**2, 0.1**2, 0.02**2))
"""What a map may be off at one place while it lies well as a whole: what the pose graph leaves of bends."""


def askew_at(atlas: Atlas, T_map_base: Array, first: int | None) -> Array:
    """Covariance (m, m, rad; map axes) of the map in the survey's frame at a place of it.

    ``first``: key of the first submap that is no part of that map, if there is one. By light at the submaps or by what
    was known when the map was left, whichever is surer here.
    """
    off = T_map_base - atlas.T_askew
    left = atlas.askew.copy()
    swing(float(off[0]), float(off[1]), left)
    lit = [one for one in atlas.submaps.values() if one.light is not None and (first is None or one.key < first)]
    if not lit:
        return left
    whole = as_a_whole(lit, T_map_base) + BENT
    return left if np.trace(left) < np.trace(whole) else whole


def as_a_whole(lit: list[Submap], T_map_base: Array) -> Array:
    """Covariance by light at each of these submaps, carried to a place; wider where map and light disagree."""
    told = [one.light for one in lit if one.light is not None]
    P = APART * np.array([P for _, P in told])
    at = np.array([one.T_map_submap for one in lit])
    off = np.array([T for T, _ in told]) - at
    off[:, 2] = se2.wrap(off[:, 2])
    misfit = np.einsum("ki,kij,kj->k", off, inverse3(P), off)
    F = np.tile(np.eye(3), (len(lit), 1, 1))
    F[:, 0, 2], F[:, 1, 2] = at[:, 1] - T_map_base[1], T_map_base[0] - at[:, 0]
    L = inverse3(F @ P @ F.transpose(0, 2, 1)).sum(axis=0)
    return np.asarray(invert3(L) * max(1.0, float(misfit.mean()) / 3.0))
