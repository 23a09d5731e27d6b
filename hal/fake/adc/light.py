"""Light sources for the fake converter: ordinary mains lamps, or a recorded signal."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from hal.errors import DataInvalid
from hal.fake.adc.i2c_timing import Times

MIDDLE: Final = 0.5
"""Rest level of an AC-coupled input, as a fraction of full scale."""
Fractions = npt.NDArray[np.float64]


class OrdinaryLamps:
    """Lamps without codes that flicker with the mains.

    Args:
        mains_hz: the lamps flicker at twice that. swing: amplitude, as a fraction of full scale.
        noise: one sigma of each sample. seed: of the noise.
    """

    def __init__(self, mains_hz: float = 50.0, swing: float = 0.1, noise: float = 3e-4, seed: int = 0) -> None:
        self._omega, self._swing, self._noise = 4.0 * np.pi * mains_hz, swing, noise
        self._random = np.random.default_rng(seed)

    def __call__(self, t_mono: Times) -> Fractions:
        """See :data:`hal.fake.adc.chips.SampleSource`."""
        phase = self._omega * t_mono
        wave = np.sin(phase) + 0.2 * np.sin(2.0 * phase + 0.7)
        return np.asarray(MIDDLE + self._swing * wave + self._noise * self._random.standard_normal(t_mono.size))


class RecordedLight:
    """A signal from a file, repeated from its beginning.

    Args:
        path: an ``.npz`` file with ``fraction`` (of full scale, evenly spaced) and ``rate_hz``.

    Raises:
        DataInvalid: not a file of that kind.
    """

    def __init__(self, path: Path) -> None:
        try:
            with np.load(path, allow_pickle=False) as archive:
                fraction = np.asarray(archive["fraction"], dtype=np.float64)
                self._rate_hz = float(archive["rate_hz"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataInvalid(
                str(path), f"not a recorded light: {error}", "needs arrays fraction and rate_hz"
            ) from error
        if fraction.ndim != 1 or fraction.size < 2 or not np.isfinite(fraction).all() or not self._rate_hz > 0.0:
            raise DataInvalid(str(path), "fraction must be a row of finite numbers, rate_hz positive")
        self._fraction = np.append(fraction, fraction[0])
        self._count = fraction.size

    def __call__(self, t_mono: Times) -> Fractions:
        """See :data:`hal.fake.adc.chips.SampleSource`; linear interpolation between the samples."""
        at = np.mod(t_mono * self._rate_hz, self._count)
        below = at.astype(np.int64) % self._count
        part = at - np.floor(at)
        return np.asarray((1.0 - part) * self._fraction[below] + part * self._fraction[below + 1])
