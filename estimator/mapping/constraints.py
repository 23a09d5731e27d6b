"""Edges of the pose graph between submaps: relative poses by odometry and by loop closures, with their information."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from estimator.mapping.pose_graph import UPPER
from estimator.numerics import se2
from estimator.numerics.arrays import Array, Bools, Ints
from estimator.numerics.symmetric3 import invert3

MANY: Final = 3
"""Most loops kept between the same two submaps."""


@dataclass(slots=True, eq=False)
class Constraints:
    """Edges between submaps; arrays with one row each.

    Attributes:
        between: (m, 2) keys of two submaps a, b.
        T: (m, 3) T_a_b.
        information: (m, 6), upper triangle, in b's axes.
        loop: (m,) whether it is a loop, which may be false.
    """

    between: Ints = field(default_factory=lambda: np.empty((0, 2), np.int64))
    T: Array = field(default_factory=lambda: np.empty((0, 3)))
    information: Array = field(default_factory=lambda: np.empty((0, 6)))
    loop: Bools = field(default_factory=lambda: np.empty(0, np.bool_))

    def add(self, a: int, b: int, T_a_b: Array, P: Array, is_loop: bool) -> None:
        """Add an edge between two submaps; ``P`` is the covariance of T_a_b in b's axes.

        Of many loops of a pair the latest stay, and of many odometry edges the most certain one. So the number of
        submaps bounds the number of edges, however often submaps between them are removed.
        """
        same = np.flatnonzero((self.loop == is_loop) & (np.sort(self.between, axis=1) == sorted((a, b))).all(axis=1))
        if len(same) >= (MANY if is_loop else 1):
            if not is_loop and np.trace(self.seen_from(a, int(same[0]))[2]) <= np.trace(P):
                return
            self.keep(np.arange(len(self.loop)) != same[0])
        H = invert3(P)
        self.between = np.vstack((self.between, (a, b)))
        self.T = np.vstack((self.T, T_a_b))
        self.information = np.vstack((self.information, [H[i, j] for i, j in UPPER]))
        self.loop = np.append(self.loop, is_loop)

    def keep(self, which: Bools) -> None:
        """Remove all other edges."""
        self.between, self.T = self.between[which], self.T[which]
        self.information, self.loop = self.information[which], self.loop[which]

    def split(self, first: int) -> Constraints:
        """Remove and return the edges between submaps with keys below ``first``; edges across that limit are lost."""
        a, b = (self.between < first).T
        which = a & b
        out = Constraints(self.between[which], self.T[which], self.information[which], self.loop[which])
        self.keep(~(a | b))
        return out

    def put(self, other: Constraints) -> None:
        """Add all edges of another set."""
        self.between, self.T = np.vstack((other.between, self.between)), np.vstack((other.T, self.T))
        self.information = np.vstack((other.information, self.information))
        self.loop = np.append(other.loop, self.loop)

    def covariance(self, row: int) -> Array:
        """Covariance of an edge's T, 3x3, in b's axes."""
        H = np.empty((3, 3))
        for k, (i, j) in enumerate(UPPER):
            H[i, j] = H[j, i] = self.information[row, k]
        return invert3(H)

    def of(self, key: int) -> Ints:
        """Rows of the edges of this submap."""
        return np.flatnonzero((self.between == key).any(axis=1))

    def seen_from(self, key: int, row: int) -> tuple[int, Array, Array]:
        """The other submap of an edge: its key, T_key_other, and the covariance of that in the other's axes."""
        a, b = self.between[row].tolist()
        T, P = self.T[row], self.covariance(row)
        if a == key:
            return b, T, P
        A = se2.adjoint(T)
        return a, se2.inverse(T), A @ P @ A.T

    def reroute(self, key: int, hub: int, T_hub_key: Array, P: Array, rows: Ints | None = None) -> None:
        """Remove a submap and connect its other neighbours with ``hub`` through it; ``P`` in its axes.

        ``rows``: edges that are passed on so, all if None.
        """
        rows = self.of(key) if rows is None else rows
        others = [(*self.seen_from(key, row), bool(self.loop[row])) for row in rows]
        self.keep(~(self.between == key).any(axis=1))
        for other, T, P_other, is_loop in others:
            if other != hub:
                A = se2.adjoint(se2.inverse(T))
                self.add(hub, other, se2.compose(T_hub_key, T), A @ P @ A.T + P_other, is_loop)
