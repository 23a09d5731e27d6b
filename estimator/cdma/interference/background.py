"""Light without a code, to be taken out of a block: mains flicker, offset, drift, and PWM-dimmed lamps."""

from __future__ import annotations

from typing import Final

import numpy as np

from estimator.cdma.air_interface import Profile
from estimator.cdma.anomalies.saturation import recoveries
from estimator.cdma.correlation_kernels import inner, mixed
from estimator.cdma.interference.pwm_lamps import PwmLamps
from estimator.cdma.interference.pwm_waveform import orthonormal
from estimator.cdma.mains_rejection import Mains
from estimator.cdma.sample_block import Fit
from estimator.numerics.arrays import Array

MOVED: Final = 0.1
"""Shift of pulses (samples) that makes the rows of a block stale: they span its square, its cube is 2e-4 of a swing."""


class Background:
    """Trackers of the light without a code, with the orthonormal rows that span it in a block.

    Attributes:
        mains: flicker of the mains. pwm: PWM-dimmed lamps.
    """

    def __init__(self, profile: Profile) -> None:
        """Nothing known of the light."""
        self._profile = profile
        self._overdriven = False
        self.mains = Mains(profile.sample_rate, profile.mains_harmonics)
        self.pwm = PwmLamps(profile)

    def rows(self, y: Array, mask: Array, overdriven: bool) -> Array:
        """Orthonormal rows (M, N) for a new block ``y`` (N,), which is 0 where ``mask`` is.

        ``overdriven``: the mask contains saturation of the first stage.
        """
        self._overdriven = overdriven
        mains = self.mains.rows(y)
        masked = mask.min() == 0.0
        if not (masked or len(self.pwm)):
            return mains
        times = np.arange(len(y), dtype=np.float64)
        if masked:
            mains = self._slow(times, mask)
        if len(self.pwm):
            self.pwm.find_phases(y - mixed(inner(mains, y), mains), mains)
        return self.pwm.rows(times, mask, mains)

    def refine(self, light: Array) -> bool:
        """Find the phases of PWM lamps again in a block without coded lamps; returns whether the rows have changed."""
        if not len(self.pwm):
            return False
        mains = self.mains.rows(light)
        return self.pwm.find_phases(light - mixed(inner(mains, light), mains), mains) > MOVED

    def masked(self, times: Array, mask: Array) -> Array:
        """Orthonormal rows for the same block with masked samples or a corrected time base; ``times`` in samples."""
        return self.pwm.rows(times, mask, self._slow(times, mask))

    def _slow(self, times: Array, mask: Array) -> Array:
        """Rows of the mains for masked samples, with the recoveries from saturation."""
        if not self._overdriven:
            return self.mains.masked(times, mask)
        rows = np.concatenate((self.mains.basis(times) * mask, recoveries(mask, self._profile)))
        return orthonormal(rows, np.empty((0, len(times))))

    def learn_mains(self, y: Array, mask: Array) -> None:
        """Track the flicker of a block without other disturbances, for the next one."""
        if self._overdriven or len(self.pwm):
            more = recoveries(mask, self._profile) if self._overdriven else np.empty((0, len(y)))
            self.mains.learn_masked(y, mask, np.concatenate((more, self.pwm.raw_rows(len(y)) * mask)))
        else:
            self.mains.learn(y)

    def learn(self, light: Array, residual: Array) -> None:
        """Track the PWM lamps, for the next block; ``light``: (N,) a block without coded lamps; its ``residual``."""
        if self.pwm.due(float(np.vdot(residual, residual))):
            self.pwm.learn(light, residual, self.mains.rows(light))

    def learn_beyond(self, fit: Fit) -> None:
        """Track the PWM lamps by what the coded lamps of a fit leave."""
        if self.pwm.due(fit.noise_var * len(fit.residual)):
            light = fit.residual + fit.nuisance
            self.pwm.learn(light, fit.residual, self.mains.rows(light))
