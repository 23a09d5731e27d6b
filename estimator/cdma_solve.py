"""Joint least squares of one block: all lamps in view, their code phases, the common clock, offset and mains at once.

Unknown are [amplitude of each lamp | code phase of each lamp | common lag | common clock | stalls]; the rows of the
mains subspace are eliminated beforehand. Phases have priors from the tracks, so that a weak lamp keeps its predicted
phase while a strong one corrects it. Amplitude and phase are bilinear: a few Gauss-Newton steps.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma_block import Fit, Prior, Sampled
from estimator.cdma_kernels import columns, invert, mixed
from estimator.cdma_pieces import REACH, Signs, data_signs, reduced, stacked

Array = npt.NDArray[np.float64]

MAX_STEPS: Final = 6
SETTLED: Final = 0.006
"""Chips: a last step below this is corrected for to second order and leaves less than 1e-4 of the amplitude."""


def joint_fit(block: Sampled, prior: Prior, table: Array) -> Fit:
    """Solve one block for all lamps of ``prior`` (at least one)."""
    return _Newton(block, prior, table, data_signs(block, prior, table)).run()


class _Newton:
    """Gauss-Newton on one block; the state is the corrections so far.

    ``rows`` stacks the columns of the system: values (L), slopes (L), clock, stalls, and one for each code period whose
    sign is not certain, with an amplitude of its own. The unknowns are the same with one more, the lag, behind the
    slopes, because each phase moves with both its own correction and the lag.
    """

    def __init__(self, block: Sampled, prior: Prior, table: Array, first: Signs) -> None:
        guess = np.sum(np.abs(first.soft) / first.soft_var, axis=1) / np.sum(1.0 / first.soft_var, axis=1)
        n = len(guess)
        self.block, self.prior, self.table, self.first = block, prior, table, first
        self.amplitude, self.phase = guess, np.zeros(n)
        self.common = np.array([first.lag, first.clock, *np.zeros(len(block.steps))])  # lag, clock, stalls
        self.loose = np.nonzero(first.signs == 0.0)
        free = 2 * n + 1 + len(block.steps) + len(self.loose[0])
        self.stack = stacked(block, free)
        self.rows = self.stack[:free]
        self.freedom = max(int(block.mask.sum()) - len(block.q) - free, 1)
        self.precision = np.zeros(free + 1)
        self.precision[n : 2 * n + 2] = [*(1 / prior.phase_var), 1 / prior.lag_var, 1 / prior.clock_var]
        self.precision[free + 1 - len(self.loose[0]) :] = 1.0 / (4.0 * guess[self.loose[0]] ** 2 + 1e-12)

    def run(self) -> Fit:
        """Iterate until the steps are small."""
        n, noise_var = len(self.phase), self.first.noise_var
        for _ in range(MAX_STEPS):
            self._build()
            scale = self.amplitude
            theta, variance, noise_var = self._solve(noise_var)
            if self._move(theta, np.sqrt(variance[:n])) < SETTLED:
                break
        weights = np.delete(theta, 2 * n)
        weights[n : 2 * n] = scale * (theta[n : 2 * n] + theta[2 * n])
        residual = self.block.project(self.block.y - mixed(weights, self.rows))
        return Fit(
            amplitude=self.amplitude,
            amplitude_var=variance[:n],
            phase=self.phase,
            phase_var=variance[n : 2 * n],
            lag=float(self.common[0]),
            lag_var=float(variance[2 * n]),
            clock=float(self.common[1]),
            clock_var=float(variance[2 * n + 1]),
            steps=self.common[2:],
            residual=residual,
            noise_var=noise_var,
            soft=self.first.soft,
            soft_var=self.first.soft_var,
            signs=self.first.signs,
            mixed_slope=mixed(self.amplitude, self.rows[n : 2 * n]),
        )

    def _build(self) -> None:
        """Columns at the present phases."""
        block, prior, n = self.block, self.prior, len(self.phase)
        x = block.x * (1.0 + self.common[1])
        for at, chips in zip(block.steps, self.common[2:], strict=True):
            x[at:] += chips
        samples, lamps = np.stack([x, block.mask]), prior.lamps(self.common[0] + self.phase)
        columns(prior.chips, lamps, samples, self.first.signs, self.table, self.rows[: 2 * n].reshape(2, n, len(x)))
        slope = mixed(self.amplitude, self.rows[n : 2 * n])
        self.rows[2 * n] = slope * block.x
        for k, at in enumerate(block.steps):
            self.rows[2 * n + 1 + k] = slope
            self.rows[2 * n + 1 + k, :at] = 0.0
        lamp, period = self.loose
        if len(lamp):
            only = np.zeros((len(lamp), self.first.signs.shape[1]))
            only[range(len(lamp)), period] = 1.0
            waves = np.empty((2, len(lamp), len(x)))
            columns(prior.chips[lamp], np.ascontiguousarray(lamps[:, lamp]), samples, only, self.table, waves)
            self.rows[-len(lamp) :] = waves[0]

    def _solve(self, noise_var: float) -> tuple[Array, Array, float]:
        """Unknowns, their variances and the noise; corrections are from the present phases."""
        n, free = len(self.phase), len(self.rows)
        matrix, right, power = reduced(self.stack, free)
        at = np.delete(np.arange(free + 1), 2 * n)
        unit = np.ones(free)
        unit[n : 2 * n] = self.amplitude
        matrix *= unit[:, None] * unit
        normal, target = np.empty((free + 1, free + 1)), np.empty(free + 1)
        normal[np.ix_(at, at)] = matrix
        shared = matrix[n : 2 * n].sum(axis=0)
        normal[2 * n, at] = normal[at, 2 * n] = shared
        normal[2 * n, 2 * n] = shared[n : 2 * n].sum()
        target[at] = unit * right
        target[2 * n] = target[n : 2 * n].sum()
        weight = noise_var * self.precision
        current = np.zeros(free + 1)
        current[n : 2 * n] = self.phase
        current[2 * n : 2 * n + 2] = self.common[:2]
        inverse = normal + np.diag(weight + 1e-9 * normal.diagonal())
        invert(inverse)
        theta = np.einsum("ij,j->i", inverse, target - weight * current)
        left = power - 2 * np.einsum("i,i->", theta, target) + np.einsum("i,ij,j->", theta, normal, theta)
        variance = noise_var * inverse.diagonal()  # of what has a prior: by the noise that weighed the prior
        noise_var = max(float(left), 1e-30) / self.freedom
        variance[:n] = noise_var * inverse.diagonal()[:n]
        self.bend = 0.5 * matrix[range(n, 2 * n), range(n, 2 * n)] / self.amplitude**2 / matrix[range(n), range(n)]
        return theta, variance, noise_var

    def _move(self, theta: Array, sigma: Array) -> float:
        """Take the step, no farther than the columns reach; returns its size in chips where it matters.

        The amplitude is corrected for the curvature of the correlation peak (slope energy over value energy).
        """
        n, more = len(self.phase), len(self.common) - 2
        own = np.clip(theta[n : 2 * n], -REACH, REACH)
        rest = np.clip(theta[2 * n : 2 * n + 2 + more], -REACH, REACH)
        rest[1] = np.clip(rest[1], -REACH / self.block.x[-1], REACH / self.block.x[-1])
        behind = 1.0 - np.array(self.block.steps, np.float64) / len(self.block.x)
        moved = own + rest[0] + float(np.einsum("i,i->", behind, rest[2:]))
        strong = np.abs(theta[:n]) > 5.0 * sigma
        self.amplitude = np.abs(theta[:n]) * (1.0 + self.bend * np.minimum(np.abs(moved), 2 * SETTLED) ** 2)
        self.phase = self.phase + own
        self.common = self.common + rest
        return float(max([*np.abs(moved[strong]), abs(rest[1]) * self.block.x[-1], *np.abs(rest[2:])]))
