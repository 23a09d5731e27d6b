"""Pulse of one Manchester chip after LED, low-pass and AC coupling, tabulated for the kernels.

The low-pass has component tolerances. An error of 10 % of its corner would leave 4 % of a strong lamp's light
unexplained. A weak lamp has no more. `Shape` estimates the corner from the residual.
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np

from estimator.cdma.air_interface import Profile
from estimator.cdma.correlation_kernels import columns, mixed
from estimator.cdma.sample_block import Fit, Prior, Sampled
from estimator.numerics.arrays import Array

STEPS: Final = 512
"""Table points per chip; expansion around the nearest is good to 5e-5 of the pulse, to 4e-4 at its corners."""

REACH: Final = 0.25
"""Largest relative error of the low-pass corner that is accepted."""

GAIN: Final = 0.7
"""Share of an error that is corrected at a time."""

SOON, LATER = 2, 16
"""Blocks between two updates of the shape: `SOON` while it is wrong, this when it is right."""

WORTH: Final = 5e-4
"""Relative corner error that justifies a new table."""


def pulse_table(profile: Profile, corner: float = 1.0) -> Array:
    """Rows at k / STEPS chips: pulse in its own chip, in the next one, and the slopes of both per chip; (STEPS + 1, 4).

    Gain is 1 for a current that lies between the two corners: an amplitude is that of the photocurrent. The pulse later
    than one chip after its end is 1e-3 of it (the coupling's droop) and is neglected.

    Args:
        profile: chip rate and front end.
        corner: factor on the low-pass corner.
    """
    chip, front = 1.0 / profile.chip_rate, profile.front_end
    low, high = 2 * np.pi * front.lpf_hz * corner * chip, 2 * np.pi * front.hpf_hz * chip
    rise = chip / front.led_tau_s
    chain = np.array(  # lamp, low-pass and its rate, low-pass inside the AC coupling
        [[-rise, 0, 0, 0], [0, 0, 1, 0], [low**2, -(low**2), -np.sqrt(2) * low, 0], [0, high, 0, -high]]
    )
    rates, modes = np.linalg.eig(chain)
    final = np.array([1.0, 1.0, 0.0, 1.0])  # final state of the step response
    weights = modes * np.linalg.solve(modes, -final)
    t = np.arange(2 * STEPS + 1) / STEPS
    states = np.zeros((4, len(t)))
    for begin, jump in ((0.0, 1.0), (0.5, -2.0), (1.0, 1.0)):
        age = t - begin
        decay = np.exp(rates[:, None] * np.maximum(age, 0.0))
        states += jump * np.where(age >= 0.0, final[:, None] + (weights @ decay).real, 0.0)
    pulse = states[1] - states[3]
    slope = states[2] - high * pulse
    own, following = slice(0, STEPS + 1), slice(STEPS, 2 * STEPS + 1)
    return np.column_stack([pulse[own], pulse[following], slope[own], slope[following]])


@cache
def pulse_energy(profile: Profile) -> float:
    """Mean square of an endless code of amplitude 1; the tails of neighbours are taken as independent."""
    table = pulse_table(profile)
    return float(np.mean(table[:-1, 0] ** 2 + table[:-1, 1] ** 2))


class Shape:
    """Pulse table in use, and the estimate of the low-pass corner."""

    def __init__(self, profile: Profile) -> None:
        """Start with the nominal corner of the profile."""
        self._profile = profile
        self._wait = SOON
        self.corner = 1.0
        self._make()

    def _make(self) -> None:
        """Compute the table and its derivative by the corner."""
        self._built = self.corner
        self.table = pulse_table(self._profile, self.corner)
        more, less = (pulse_table(self._profile, self.corner * factor) for factor in (1.01, 0.99))
        self._derivative = (more - less) / 0.02

    def learn(self, block: Sampled, prior: Prior, fit: Fit) -> None:
        """Correct the corner every few blocks: correlate the residual with the signal's derivative by it."""
        self._wait -= 1
        if self._wait:
            return
        self._wait = LATER
        waves = np.empty((2, len(fit.amplitude), len(block.x)))
        lamps = prior.lamps(fit.phase + fit.lag)
        lamps[1] *= 1.0 + fit.clock
        columns(prior.chips, lamps, block.samples, fit.signs, self._derivative, waves)
        change = mixed(fit.amplitude, waves[0])
        columns(prior.chips, lamps, block.samples, fit.signs, self.table, waves)
        seen = change = block.project(change)
        for wave in np.einsum("i,kij->kj", fit.amplitude, waves):  # the joint fit has solved for amplitude and delay
            row = block.project(wave)
            change = change - row * float(np.dot(change, row) / max(np.dot(row, row), 1e-12))
        energy = float(np.dot(change, change))
        if energy < 1e-3 * float(np.dot(seen, seen)) or energy < 100.0 * fit.noise_var:
            return  # too faint
        error = float(np.dot(change, fit.residual)) / energy
        self.corner = float(np.clip(self.corner * (1.0 + GAIN * error), 1.0 - REACH, 1.0 + REACH))
        if abs(error) > 4.0 * WORTH:
            self._wait = SOON

    def renew(self) -> None:
        """Recompute the table if the corner has changed: half a millisecond, so not within a block update."""
        if abs(self.corner - self._built) > WORTH:
            self._make()
