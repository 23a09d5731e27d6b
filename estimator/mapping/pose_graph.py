"""Robust pose graph optimisation: sparse Gauss-Newton over planar poses, with loops that may be false.

Minimises ``sum e^T H e`` with ``e = T_z^-1 (T_i^-1 T_j)`` for an edge ``T_z`` between poses i and j, and ``e = T_z^-1
T_i`` for an absolute prior. An edge that may be false counts by Geman-McClure's cost. There are two descents to its
minimum. Where the first leaves an edge rejected, the second runs too, and the lower minimum counts:

* From the scale that noise explains: edges that agree with odometry are accepted first, reduce the covariance, and so
  bring in further ones. Many false edges never get any weight. Neither does a true one after much drift.
* From a scale wide enough to accept every edge, narrowed step by step (graduated non-convexity: Yang, Antonante,
  Tzoumas, Carlone, RA-L 5(2), 2020). Drift does no harm, but a third of false edges may deform the graph for good.

Steps that do not descend are damped (Levenberg-Marquardt).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.mapping.pose_graph_kernels import descend, marginal, parts_of, worst
from estimator.numerics.arrays import Array, Bools, Ints
from estimator.numerics.elimination_ordering import adjacency, columns, minimum_degree

UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
"""Order of the six numbers of an information matrix: the g2o format's."""


@dataclass(slots=True, eq=False)
class Graph:
    """Poses with their edges and absolute priors; arrays have one row per pose, edge or prior.

    Attributes:
        poses: (n, 3) x, y, yaw: the start.
        edges: (m, 2) poses i, j.
        between: (m, 3) T_i_j.
        information: (m, 6), upper triangle by rows.
        doubtful: (m,) whether the edge may be false.
        anchored: (p,) poses with an absolute prior.
        at: (p, 3) its pose.
        certainty: (p, 6) its information; priors may always be false.
        held: (n,) poses that never move; empty: none.
    """

    poses: Array
    edges: Ints
    between: Array
    information: Array
    doubtful: Bools
    anchored: Ints = field(default_factory=lambda: np.empty(0, np.int64))
    at: Array = field(default_factory=lambda: np.empty((0, 3)))
    certainty: Array = field(default_factory=lambda: np.empty((0, 6)))
    held: Bools = field(default_factory=lambda: np.zeros(0, np.bool_))


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """Result of the optimisation.

    Attributes:
        poses: (n, 3).
        chi2: of all edges as weighted.
        iterations: of Gauss-Newton, in both descents.
        converged: not stopped by the cap.
        trust: (m,) weight of each edge, 1 where it is not doubtful, near 0 where it is rejected.
        parts: number of connected components; each keeps its first pose unless one of its poses is held or has a prior.
        covariance: (3, 3) marginal covariance of the requested pose, in the map's axes. Zeros for a held pose, or
            without a request.
    """

    poses: Array
    chi2: float
    iterations: int
    converged: bool
    trust: Array
    parts: int
    covariance: Array


def optimise(
    graph: Graph, most: int = 50, settled: float = 1e-4, phi: float = 10.0, covariance_of: int = -1
) -> Solution:
    """Optimise from ``graph.poses``.

    Args:
        graph: is not changed.
        most: cap on iterations, of each descent.
        settled: relative decrease of chi2 that ends them.
        phi: chi2 of three degrees of freedom at which a doubtful edge keeps a quarter of its weight.
        covariance_of: pose whose covariance is requested, -1 for none.

    Raises:
        ValueError: indices out of range, or numbers that are not finite.
    """
    check(graph)
    n = len(graph.poses)
    part = parts_of(n, graph.edges)
    free = ~graph.held if len(graph.held) else np.ones(n, np.bool_)
    fixed = np.concatenate((part[graph.anchored], part[~free]))
    roots = np.flatnonzero(part == np.arange(n))
    free[np.setdiff1d(roots, fixed)] = False
    label = np.where(free, np.cumsum(free) - 1, -1)
    edges = np.ascontiguousarray(label[graph.edges])
    first, near = adjacency(int(free.sum()), edges)
    order, start, fill = minimum_degree(first, near)
    pattern = columns(order, start, fill)
    place = np.full(n, -1)
    place[np.flatnonzero(free)[order]] = np.arange(len(order))
    given = (graph.edges, graph.between, graph.information, graph.doubtful)
    absolute = (graph.anchored, graph.at, graph.certainty)
    poses, trust = graph.poses.copy(), np.ones(len(graph.edges))
    told = np.array((float(most), settled, phi, phi))
    chi2, iterations, converged = descend(poses, given, absolute, (place, pattern), trust, told)
    if worst(poses, given, absolute) > phi:
        others, doubts = graph.poses.copy(), np.ones(len(graph.edges))
        told[3] = 2.0 * worst(others, given, absolute)
        wide, more, settles = descend(others, given, absolute, (place, pattern), doubts, told)
        iterations += more
        if wide < chi2:
            poses, trust, chi2, converged = others, doubts, wide, settles
    covariance = np.zeros((3, 3))
    if covariance_of >= 0 and place[covariance_of] >= 0:
        marginal(poses, given, absolute, (place, pattern), (trust, phi, int(place[covariance_of])), covariance)
    return Solution(poses, chi2, int(iterations), bool(converged), trust, len(roots), covariance)


def check(graph: Graph) -> None:
    """Validate a graph.

    Raises:
        ValueError: with the name of the invalid array.
    """
    n = len(graph.poses)
    for name, index in (("edges", graph.edges), ("anchored", graph.anchored)):
        if len(index) and (index.min() < 0 or index.max() >= n):
            raise ValueError(f"{name}: a constraint names pose {index.min()} or {index.max()}, there are 0 to {n - 1}")
    if len(graph.held) not in (0, n):
        raise ValueError(f"held: {len(graph.held)} rows for {n} poses")
    for name, values in (
        ("poses", graph.poses), ("between", graph.between), ("information", graph.information), ("at", graph.at),
        ("certainty", graph.certainty),
    ):  # fmt: skip
        if not np.isfinite(values).all():
            raise ValueError(f"{name}: not finite in row {int(np.argwhere(~np.isfinite(values))[0][0])}")
