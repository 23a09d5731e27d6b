"""Twins: a second lamp of the same code, so close in phase that acquisition cannot separate it from the first.

The residual of the joint fit shows it. A slow lamp leaves a similar residual, so both are tried: two copies of the
code, each at a phase of its own, against one copy with another rise time. Data signs are free in each code period.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import Profile
from estimator.cdma.chip_pulse import Shape, slow_table
from estimator.cdma.correlation_kernels import columns, gram
from estimator.cdma.sample_block import Fit, Prior, Sampled, rows_of
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

NEAR: Final = np.array((-0.3, -0.15, 0.0, 0.15, 0.3))
"""Trial phases of the first lamp, chips from where it is tracked: two lamps alike are tracked between them."""
FAR: Final = np.concatenate((np.arange(-18, -1), np.arange(2, 19))) * 0.1
"""Trial phases of the second one."""
APART: Final = 0.18
"""Least distance of the two, chips."""

SUSPECT: Final = 0.1
"""Share of the residual's energy near one lamp's code that makes a twin or a slow lamp worth trying."""

BETTER: Final = 0.6
"""Energy that two lamps leave, over that which a slow lamp leaves and over that of the joint fit."""

SMALLEST: Final = 0.05
"""Smallest amplitude of the second lamp, as a share of the first: errors of the pulse shape look like weaker ones."""

LEADERS: Final = 4
"""Lamps, the strongest first, that are tested for a twin."""

SHORTEST: Final = 40
"""Samples of a code period from which it counts."""

REFINED: Final = 2
"""Gauss-Newton steps from the best trial phases."""

RISES_S: Final = (10e-6, 20e-6, 40e-6, 80e-6)
"""Rise times between which a single slow lamp is tried."""

RIDGE: Final = 1e-6
"""Relative regularisation of waveforms that are alike."""


@dataclass(frozen=True)
class Twin:
    """Two lamps in place of one: its index in the fit; shift of the first and of the second (chips); amplitudes."""

    lamp: int
    first: float
    second: float
    first_amplitude: float
    amplitude: float


@cache
def slower(profile: Profile) -> list[Array]:
    """Pulse tables (1, S, 4) of slow lamps, by rise time."""
    return [slow_table(profile, rise_s)[None] for rise_s in RISES_S]


def find_twin(block: Sampled, prior: Prior, fit: Fit, shape: Shape, profile: Profile) -> Twin | None:
    """The lamp that explains the residual better as two lamps than as one, slow or not; None if there is none."""
    energy = float(np.vdot(fit.residual, fit.residual))
    shares = {
        lamp: _suspicion(block, prior, fit, lamp, shape.tables)
        for lamp in np.argsort(-fit.amplitude)[:LEADERS].tolist()
        if fit.amplitude[lamp] > 0.0
    }
    lamp = max(shares, key=lambda k: shares[k], default=-1)
    if lamp < 0 or shares[lamp] < SUSPECT * energy:
        return None
    own = shape.tables[int(prior.pulse[lamp])][None]
    single = [_waves(block, prior, fit, lamp, np.zeros(1), own)[0][:, 0]]
    for rise_s, rise in zip(RISES_S, slower(profile), strict=True):
        later = np.array((rise_s * profile.chip_rate,))
        single.append(_waves(block, prior, fit, lamp, later, rise)[0][:, 0])
    return _as_two(block, prior, fit, lamp, own, np.concatenate(single))


def _suspicion(block: Sampled, prior: Prior, fit: Fit, lamp: int, tables: Array) -> float:
    """Energy of the residual in copies of one lamp's code beside it."""
    shifts = np.array((-1.5, -1.2, -0.9, -0.6, -0.3, 0.3, 0.6, 0.9, 1.2, 1.5))
    own = tables[int(prior.pulse[lamp])][None]
    waves, bounds = _waves(block, prior, fit, lamp, shifts, own)
    sums = np.concatenate((np.zeros((len(shifts), 1)), np.cumsum(waves[0] * fit.residual, axis=1)), axis=1)
    parts = np.take_along_axis(sums, bounds, axis=1)
    energy = np.maximum(np.einsum("kn,kn->k", waves[0], waves[0]), 1e-12)
    return float((np.abs(np.diff(parts, axis=1)).sum(axis=1) ** 2 / energy).max())


def _waves(block: Sampled, prior: Prior, fit: Fit, lamp: int, shifts: Array, table: Array) -> tuple[Array, Index]:
    """(2, S, N) unsigned waveforms and slopes of one lamp's code at these shifts, and the bounds of their periods."""
    count = len(shifts)
    waves, ones = np.empty((2, count, len(block.x))), np.ones((count, fit.soft.shape[1]))
    phases = prior.phase[lamp] + fit.phase[lamp] + fit.lag + shifts
    lamps = rows_of(phases, np.full(count, prior.rate[lamp] * (1.0 + fit.clock)))
    return waves, columns(prior.chips[[lamp] * count], lamps, block.samples, ones, table, waves)


def _as_two(block: Sampled, prior: Prior, fit: Fit, lamp: int, table: Array, single: Array) -> Twin | None:
    """The two lamps in place of one, if they explain the block better.

    ``single``: value and slope of one lamp for each rise time.
    """
    own, bounds = _waves(block, prior, fit, lamp, np.zeros(1), table)
    light = fit.residual + fit.amplitude[lamp] * _by_period(fit.signs[lamp], bounds[0], len(block.x)) * own[0, 0]
    parts = [slice(low, high) for low, high in pairwise(bounds[0].tolist()) if high - low >= SHORTEST]
    total = sum(float(np.vdot(light[part], light[part])) for part in parts)
    trial = np.array([(k, k + 1, k + 2, k + 3) for k in range(0, len(single) - 3, 2)])
    one = total - float(_solved(single, trial, light, parts)[0].max())
    shifts, two, amplitudes = _best_pair(block, prior, fit, lamp, table, light, parts)
    now = sum(float(np.vdot(fit.residual[part], fit.residual[part])) for part in parts)
    if total - two > BETTER * min(one, now) or amplitudes.min() < SMALLEST * amplitudes.max():
        return None
    return Twin(lamp, float(shifts[0]), float(shifts[1]), float(amplitudes[0]), float(amplitudes[1]))


def _best_pair(
    block: Sampled, prior: Prior, fit: Fit, lamp: int, table: Array, light: Array, parts: list[slice]
) -> tuple[Array, float, Array]:
    """Shifts of the two lamps, the energy of ``light`` that they explain, and their amplitudes."""
    near, far = len(NEAR), len(FAR)
    waves, _ = _waves(block, prior, fit, lamp, np.concatenate((NEAR, FAR)), table)
    pairs = np.array([(i, near + j) for i in range(near) for j in range(far) if abs(NEAR[i] - FAR[j]) >= APART])
    trial = np.concatenate((pairs, pairs + near + far), axis=1)  # both waveforms, both slopes
    explained, weights = _solved(waves.reshape(-1, len(block.x)), trial, light, parts)
    k = int(np.argmax(explained))
    shifts, energy, weight = np.concatenate((NEAR, FAR))[pairs[k]], float(explained[k]), weights[:, k]
    for _ in range(REFINED):
        value = (weight[:, :2] ** 2).sum(axis=0)
        shifts = shifts + np.clip((weight[:, :2] * weight[:, 2:]).sum(axis=0) / np.maximum(value, 1e-12), -0.1, 0.1)
        waves, _ = _waves(block, prior, fit, lamp, shifts, table)
        explained, weights = _solved(waves.reshape(-1, len(block.x)), np.array(((0, 1, 2, 3),)), light, parts)
        energy, weight = float(explained[0]), weights[:, 0]
    return shifts, energy, np.abs(weight[:, :2]).mean(axis=0)


def _solved(rows: Array, trial: Index, light: Array, parts: list[slice]) -> tuple[Array, Array]:
    """Energy of ``light`` that each set of rows explains (T,), and their weights (P, T, R) by part of the block."""
    explained, weights = np.zeros(len(trial)), np.zeros((max(len(parts), 1), *trial.shape))
    diagonal = np.arange(trial.shape[1])
    for k, part in enumerate(parts):
        inside = np.concatenate((rows[:, part], light[None, part]))
        products = np.empty((len(inside), len(inside)))
        gram(inside, len(inside), products)
        normal = products[trial[:, :, None], trial[:, None, :]]
        normal[:, diagonal, diagonal] *= 1.0 + RIDGE
        normal[:, diagonal, diagonal] += 1e-12
        right = products[-1][trial]
        weights[k] = np.linalg.solve(normal, right[:, :, None])[:, :, 0]
        explained += np.einsum("ki,ki->k", weights[k], right)
    return explained, weights


def _by_period(signs: Array, bounds: Index, size: int) -> Array:
    """(N,) sign of each sample's code period."""
    out = np.zeros(size)
    for sign, (low, high) in zip(signs.tolist(), pairwise(bounds.tolist()), strict=True):
        out[low:high] = sign
    return out
