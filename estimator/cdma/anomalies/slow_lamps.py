"""Slow lamps: light that rises and falls later than the air interface allows, as of phosphor or a weak driver.

A slow lamp leaves the derivative of its pulse by the square of the rise time in the residual. As long as no lamp is
slow, that is all that is averaged. Once there is one, a Kalman filter estimates the squares of all lamps and the corner
of the low-pass together, and each slow lamp gets a pulse table of its own. A square is the sum of one that all lamps
share, as by one type of driver or a further low-pass of the receiver, and one of the lamp's own.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.air_interface import Profile
from estimator.cdma.chip_pulse import SLOW_S, Shape, slow_loss, slow_table
from estimator.cdma.correlation_kernels import columns, inner, mixed
from estimator.cdma.mains_rejection import orthonormal
from estimator.cdma.sample_block import Fit, Prior, Sampled, rows_of
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

SOON, LATER, SELDOM, SETTLED = 4, 16, 128, 6
"""Blocks between two updates: `SOON` for the first `SETTLED` updates after a lamp was found, then `LATER`; `SELDOM` as
long as no lamp is slow.
"""

MEMORY: Final = 0.9
"""Weight of the earlier updates, as long as no lamp is slow."""

EVIDENT: Final = 6.0
"""Sigmas from which a lamp is slow."""

SMALLEST: Final = (5e-6) ** 2
"""Excess of the square of the rise time, s^2, from which a lamp is slow; it stays slow down to half of it."""

SUSPECT: Final = 0.04
"""Relative corner error from which slow lamps may be the cause."""

CORNER, SQUARE = 0.05, (20e-6) ** 2
"""Sigmas of the corner and of a squared rise time, s^2, before any measurement."""

SHARED: Final = 0.05**2
"""Variance of the squared rise time that lamps share, in squares of `SQUARE`: the low-pass has the larger tolerance."""

PINNED: Final = 1e6
"""Precision of a corner that is at the end of its tolerance."""

CORNER_WALK, SQUARE_WALK = 3e-4, 2e-12
"""Sigmas of their change from update to update."""

SHARED_S: Final = (10e-6, 15e-6, 20e-6, 30e-6, 40e-6, 50e-6)
"""Rise times, s, that are tried for all lamps together at the start of the joint estimation."""

CLEARER: Final = 0.5
"""Energy that a shared rise time leaves, over that which the corner alone leaves, below which it is taken."""

LEADERS: Final = 4
"""Lamps, the strongest first, that decide about it."""

FURTHER_S, SLOWEST_S = 12e-6, 60e-6
"""Largest growth of a rise time at once, and largest rise time, s. A step that is too long is shortened as a whole:
the corner must not make up for what is cut off."""

ASTRAY: Final = 5.0
"""Correction in sigmas from which the estimates are astray: the next block counts as if it were the first."""

DOUBT: Final = 0.25
"""Share of the correction that is added to the sigma of an amplitude: a light need not rise exponentially."""


class SlowLamps:
    """Rise time of the lamp in each slot."""

    def __init__(self, profile: Profile, slots: int) -> None:
        """No slow lamp."""
        self._profile = profile
        self._usual_s, self._loss = profile.front_end.led_tau_s, slow_loss(profile)
        self._code = np.full(slots, -1)
        self._sums = np.zeros((2, slots))  # excess of the square by weight, weight
        self._own, self._common = np.zeros(slots), 0.0
        self._covariance = _unmeasured(slots)
        self._slow = np.zeros(slots, np.bool_)
        self._wait, self._updates = SOON, 0
        self._joint, self._astray = False, True

    def learn(self, block: Sampled, prior: Prior, fit: Fit, shape: Shape, codes: Index, slots: Index) -> None:
        """Learn from one more block, every few blocks; the corner, too, once there are slow lamps.

        ``codes``, ``slots``: of the lamps in the fit.
        """
        if not self._joint:
            shape.learn(block, prior, fit)
        self._wait -= 1
        suspect = not self._joint and abs(shape.corner - 1.0) > SUSPECT
        if (self._wait > 0 and not suspect) or (self._joint and shape.behind(slots)):
            return
        self._updates += 1
        self._assign(slots, codes, shape)
        self._wait = SOON if self._updates < SETTLED else LATER if self._joint else SELDOM
        if self._joint:
            self._estimate(block, prior, fit, shape, slots)
        elif self._test(block, prior, fit, shape, slots) or suspect:
            self._estimate_jointly(block, prior, fit, shape, slots)

    def _estimate_jointly(self, block: Sampled, prior: Prior, fit: Fit, shape: Shape, slots: Index) -> None:
        """From now on estimate the corner with the rise times, beginning with a rise time that all lamps share."""
        by_corner = self._left_by(self._usual_s, shape.corner, block, prior, fit, shape)
        shared = [self._left_by(rise_s, 1.0, block, prior, fit, shape) for rise_s in SHARED_S]
        best = int(np.argmin(shared))
        self._joint, self._wait = True, 1
        shape.set_corner(1.0)
        if shared[best] < CLEARER * by_corner:
            self._common = SHARED_S[best] ** 2 - self._usual_s**2
            self._slow[slots], shape.rise_s[slots] = True, SHARED_S[best]

    def _left_by(self, rise_s: float, corner: float, block: Sampled, prior: Prior, fit: Fit, shape: Shape) -> float:
        """Energy of the strongest lamps' light that is left if all rise with this time constant, at this corner."""
        some = np.argsort(-fit.amplitude)[:LEADERS]
        lamps = np.ascontiguousarray(prior.lamps(fit.phase + fit.lag)[:, some])
        lamps[1] *= 1.0 + fit.clock
        chips, signs = prior.chips[some], np.ascontiguousarray(fit.signs[some])
        waves = np.empty((2, len(some), len(block.x)))
        columns(chips, lamps, block.samples, signs, shape.tables, waves)
        light = block.project(fit.residual + mixed(fit.amplitude[some], waves[0]))
        lamps[0] += (rise_s - self._usual_s) * self._profile.chip_rate
        columns(chips, lamps[:2].copy(), block.samples, signs, slow_table(self._profile, rise_s, corner)[None], waves)
        rows = orthonormal(np.array([block.project(row) for row in waves.reshape(-1, len(block.x))]))[0]
        weights = inner(rows, light)
        return float(np.vdot(light, light) - np.vdot(weights, weights))

    def _assign(self, slots: Index, codes: Index, shape: Shape) -> None:
        """Forget what was known of slots that have another lamp now."""
        new = slots[self._code[slots] != codes]
        if not len(new):
            return
        self._code[slots] = codes
        self._updates = 0
        self._sums[:, new], self._slow[new], self._own[new] = 0.0, False, 0.0
        self._covariance[new], self._covariance[:, new] = 0.0, 0.0
        self._covariance[new, new] = 1.0
        shape.forget(new)

    def _test(self, block: Sampled, prior: Prior, fit: Fit, shape: Shape, slots: Index) -> bool:
        """Average the excess that the residual indicates; returns whether a lamp is evidently slow."""
        change, _ = self._derivatives(block, prior, fit, shape, None)
        energy = np.maximum(np.einsum("ij,ij->i", change, change), 1e-12)
        seen = rows_of(inner(change, fit.residual), energy) / fit.noise_var
        self._sums[:, slots] = MEMORY * self._sums[:, slots] + seen
        excess, weight = self._sums[0, slots], self._sums[1, slots]
        return bool(((excess > 0.5 * SMALLEST * weight) & (excess > EVIDENT * np.sqrt(weight))).any())

    def _derivatives(
        self, block: Sampled, prior: Prior, fit: Fit, shape: Shape, by_corner: Array | None
    ) -> tuple[Array, Array]:
        """Derivatives (L, N) of each lamp's light by its squared rise time, and of all light by the corner (N,).

        They are without what the amplitude and the phase of the lamp explain.
        """
        lamps = prior.lamps(fit.phase + fit.lag)
        lamps[1] *= 1.0 + fit.clock
        own, change, common = (np.zeros((2, len(fit.amplitude), len(block.x))) for _ in range(3))
        columns(prior.chips, lamps, block.samples, fit.signs, shape.tables, own)
        columns(prior.chips, lamps, block.samples, fit.signs, shape.derivatives, change)
        rows = _without(change[0], own) * fit.amplitude[:, None]
        if by_corner is None:
            return rows, common[0, 0]
        columns(prior.chips, lamps[:2].copy(), block.samples, fit.signs, by_corner[None], common)
        return rows, mixed(fit.amplitude, _without(common[0], own))

    def _estimate(self, block: Sampled, prior: Prior, fit: Fit, shape: Shape, slots: Index) -> None:
        """Kalman update of the squared rise times and the corner, in units of their first sigmas."""
        by_rise, by_corner = self._derivatives(block, prior, fit, shape, shape.by_corner)
        rows = np.array([block.project(row) for row in (*(by_rise * SQUARE), by_corner * CORNER)])
        off = shape.corner - shape.made_corner
        ahead = np.append(self._ahead(slots, shape) / SQUARE, off / CORNER)
        left = fit.residual - mixed(ahead, rows)  # beyond what the tables do not contain yet
        rows = np.insert(rows, len(slots), rows[:-1].sum(axis=0), axis=0)
        seen = np.append(slots, (-2, -1))
        if self._astray:
            self._covariance = _unmeasured(len(self._own))
        before = self._covariance[np.ix_(seen, seen)]
        information = np.linalg.inv(before)
        precision = information + np.einsum("ik,jk->ij", rows, rows) / fit.noise_var
        pull = inner(rows, left) / fit.noise_var
        covariance, step = _solved(precision, pull)
        if not shape.possible(shape.corner + CORNER * float(step[-1])):
            precision[-1, -1] += PINNED  # the rise times must not make up for what is cut off
            covariance, step = _solved(precision, pull)
        self._astray = bool((np.abs(step) > ASTRAY * np.sqrt(np.diag(covariance))).any())
        spread = np.einsum("ij,jk->ik", self._covariance[:, seen], information)  # to the lamps out of view, too
        change = np.einsum("ij,jk->ik", spread, covariance - before)
        self._covariance += np.einsum("ik,lk->il", change, spread)
        walk = np.append(np.full(len(self._own) + 1, SQUARE_WALK / SQUARE), CORNER_WALK / CORNER)
        self._covariance[np.diag_indices(len(walk))] += walk**2
        self._move(np.einsum("ij,j->i", spread, step), shape)
        if self._astray:
            self._wait = 1
        self._decide(slots, shape)

    def _move(self, step: Array, shape: Shape) -> None:
        """Apply a step of all slots, shortened if it is too long."""
        moved, before = SQUARE * (step[:-2] + step[-2]), self._own + self._common
        most = (np.sqrt(np.maximum(before + self._usual_s**2, 0.0)) + FURTHER_S) ** 2
        part = min(1.0, float(((most - before) / np.maximum(moved, 1e-30))[moved > 0.0].min(initial=1.0)))
        self._astray |= part < 1.0
        self._common = min(max(self._common + part * SQUARE * float(step[-2]), -(self._usual_s**2)), SLOWEST_S**2)
        self._own = np.clip(before + part * moved, -(self._usual_s**2), SLOWEST_S**2) - self._common
        shape.set_corner(shape.corner + part * CORNER * float(step[-1]))

    def _decide(self, slots: Index, shape: Shape) -> None:
        """Decide which lamps are slow."""
        enough = np.where(self._slow[slots], 0.5, 1.0)
        excess = self._excess(slots)
        all_slow = self._common > EVIDENT * SQUARE * float(np.sqrt(self._covariance[-2, -2]))
        evident = SMALLEST if all_slow else np.maximum(SMALLEST, EVIDENT * self._sigma(slots))
        self._slow[slots] = excess > enough * evident
        rise_s = np.sqrt(np.maximum(excess + self._usual_s**2, 0.0))
        shape.rise_s[slots] = np.where(self._slow[slots], rise_s, self._usual_s)

    def _excess(self, slots: Index) -> Array:
        """Squared rise times beyond the usual one, s^2."""
        excess: Array = self._own[slots] + self._common
        return excess

    def _ahead(self, slots: Index, shape: Shape) -> Array:
        """Squared rise times beyond those of the present tables."""
        ahead: Array = self._excess(slots) + self._usual_s**2 - shape.made_s[slots] ** 2
        return ahead

    def _sigma(self, slots: Index) -> Array:
        """Sigma of the squared rise times."""
        own, with_common = self._covariance[slots, slots], self._covariance[slots, -2]
        sigma: Array = SQUARE * np.sqrt(np.maximum(own + 2.0 * with_common + self._covariance[-2, -2], 0.0))
        return sigma

    def slow(self, slots: Index) -> npt.NDArray[np.bool_]:
        """Which of these lamps are slow."""
        slow: npt.NDArray[np.bool_] = self._slow[slots]
        return slow

    def pulse(self, slots: Index, codes: Index, shape: Shape) -> Array:
        """Number of the pulse table of each of these lamps; called at the begin of each block."""
        if not self._joint:
            return np.zeros(len(slots))
        self._assign(slots, codes, shape)
        pulse: Array = shape.pulse[slots]
        return pulse

    def spread(self, slots: Index, shape: Shape) -> Array | float:
        """Relative variance of the amplitudes by the uncertainty of the rise times."""
        if not self._joint:
            return 0.0
        off = np.abs(self._ahead(slots, shape)) + self._sigma(slots)
        usual = shape.pulse[slots] == 0.0
        loss, made_s = np.where(usual, self._loss, shape.loss[slots]), np.where(usual, SLOW_S, shape.made_s[slots])
        by_rise = loss * off / (made_s**2 - self._usual_s**2)
        spread: Array = (DOUBT * shape.loss[slots]) ** 2 + by_rise**2
        return spread


def _unmeasured(slots: int) -> Array:
    """Covariance before any measurement: own parts of the squared rise times, the shared part, the corner."""
    return np.diag([1.0] * slots + [SHARED, 1.0])


def _solved(precision: Array, pull: Array) -> tuple[Array, Array]:
    """Covariance and step of a Kalman update in information form."""
    covariance = np.asarray(np.linalg.inv(precision), np.float64)
    return covariance, (covariance * pull).sum(axis=1)


def _without(rows: Array, own: Array) -> Array:
    """Rows (L, N) without what value and slope (2, L, N) of the same lamp explain."""
    value, slope = own
    vv, ss, vs = (np.einsum("ij,ij->i", a, b) for a, b in ((value, value), (slope, slope), (value, slope)))
    v, s = np.einsum("ij,ij->i", value, rows), np.einsum("ij,ij->i", slope, rows)
    inverse = 1.0 / np.maximum(vv * ss - vs * vs, 1e-12)
    out: Array = rows - ((ss * v - vs * s) * inverse)[:, None] * value - ((vv * s - vs * v) * inverse)[:, None] * slope
    return out
