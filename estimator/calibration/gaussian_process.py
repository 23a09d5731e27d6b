"""Gaussian process regression over the ground: Matern-3/2 kernel, Student-t noise, leave-one-out hyperparameters.

k(p, q) = amplitude^2 (1 + u) exp(-u),  u = sqrt(3) |p - q| / length. Student-t noise (4 degrees of freedom) is a scale
mixture of Gaussians, so it is solved by iterative reweighting. Leave-one-out residuals and variances come from one
matrix inverse (Rasmussen and Williams, Gaussian Processes for Machine Learning, Eq. 5.12). They predict each value from
all others.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.numerics.arrays import Array

FREEDOM: Final = 4.0
"""Degrees of freedom of the Student-t noise."""
REWEIGHTS: Final = 5
LENGTHS_M: Final = (0.4, 0.7, 1.0, 1.5, 2.2, 3.2)
AMPLITUDES: Final = (0.02, 0.035, 0.06, 0.10, 0.16, 0.25)
NOISES: Final = (0.003, 0.006, 0.012, 0.025, 0.05, 0.09)


@dataclass(frozen=True, slots=True)
class Hyper:
    """Hyperparameters: amplitude and noise (one sigma of ln RSS), correlation length (m)."""

    amplitude: float
    length: float
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """A process conditioned on data: positions (n, 2), weights alpha (n,), inverse of the data's covariance (n, n)."""

    hyper: Hyper
    places: Array
    alpha: Array
    inverse: Array

    def at(self, places: Array) -> tuple[Array, Array]:
        """Posterior mean and one sigma at positions (m, 2)."""
        k = matern(self.hyper, places, self.places)
        mean = k @ self.alpha
        variance = self.hyper.amplitude**2 - np.einsum("ij,jk,ik->i", k, self.inverse, k, optimize=True)
        return mean, np.sqrt(np.maximum(variance, 0.0))


def matern(hyper: Hyper, a: Array, b: Array) -> Array:
    """Covariance (n, m) between positions (n, 2) and (m, 2)."""
    u = math.sqrt(3.0) / hyper.length * np.hypot(a[:, None, 0] - b[None, :, 0], a[:, None, 1] - b[None, :, 1])
    covariance: Array = hyper.amplitude**2 * (1.0 + u) * np.exp(-u)
    return covariance


def fit(hyper: Hyper, places: Array, values: Array, extra: Array | None = None) -> Field:
    """Condition the process on values (n,) at positions (n, 2); ``extra`` (n,): known variance besides the noise."""
    field, _, _ = _reweighted(hyper, places, values, np.zeros(len(values)) if extra is None else extra)
    return field


def _reweighted(hyper: Hyper, places: Array, values: Array, extra: Array) -> tuple[Field, Array, Array]:
    """The conditioned process, with leave-one-out residuals and variances (of the value without its own noise)."""
    covariance = matern(hyper, places, places)
    noise = np.full(len(values), hyper.noise**2) + extra
    base = noise.copy()
    for turn in range(REWEIGHTS):
        inverse = np.asarray(np.linalg.inv(covariance + np.diag(noise)), dtype=np.float64)
        alpha = inverse @ values
        diagonal = np.diag(inverse)
        left, spread = alpha / diagonal, np.maximum(1.0 / diagonal - noise, 0.0)
        if turn < REWEIGHTS - 1:
            # leave-one-out: an outlier must not reduce its own residual
            noise = base * (FREEDOM + left**2 / (base + spread)) / (FREEDOM + 1.0)
            noise = np.maximum(noise, base)
    return Field(hyper, places, alpha, inverse), left, spread


def score(hyper: Hyper, places: Array, values: Array, extra: Array) -> float:
    """Leave-one-out log likelihood: sum of the log density of each value given all others (Student-t)."""
    _, left, spread = _reweighted(hyper, places, values, extra)
    s2 = spread + hyper.noise**2 + extra
    constant = math.lgamma(0.5 * (FREEDOM + 1)) - math.lgamma(0.5 * FREEDOM) - 0.5 * math.log(FREEDOM * math.pi)
    t = np.log1p(left**2 / (FREEDOM * s2))
    return float((constant - 0.5 * np.log(s2) - 0.5 * (FREEDOM + 1.0) * t).sum())


def choose(data: Sequence[tuple[Array, Array, Array]]) -> Hyper:
    """Hyperparameters with the best leave-one-out likelihood over several fields (positions, values, extra).

    Coordinate search over the grids, until no step improves.
    """
    grids = (AMPLITUDES, LENGTHS_M, NOISES)
    known: dict[tuple[int, int, int], float] = {}

    def worth(at: tuple[int, int, int]) -> float:
        """Summed score at grid indices, cached."""
        if at not in known:
            hyper = Hyper(AMPLITUDES[at[0]], LENGTHS_M[at[1]], NOISES[at[2]])
            known[at] = sum(score(hyper, *part) for part in data)
        return known[at]

    best = (3, 2, 2)
    while True:
        a, b, c = best
        near = [(a + d, b, c) for d in (-1, 1)] + [(a, b + d, c) for d in (-1, 1)] + [(a, b, c + d) for d in (-1, 1)]
        # amplitude and length are strongly correlated, so they are also moved together
        near += [(a - 1, b - 1, c), (a + 1, b + 1, c)]
        found = max((at for at in near if all(0 <= i < len(g) for i, g in zip(at, grids, strict=True))), key=worth)
        if worth(found) <= worth(best):
            return Hyper(AMPLITUDES[best[0]], LENGTHS_M[best[1]], NOISES[best[2]])
        best = found
