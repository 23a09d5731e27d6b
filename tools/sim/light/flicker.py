"""How much a coded lamp flickers, line by line, against IEEE Std 1789-2015.

The standard limits the modulation (per cent) of a sinusoid of frequency f (Hz): to have no observable effect, 0.01 f
below 90 Hz and 0.0333 f up to 3 kHz; for low risk, 0.025 f below 90 Hz and 0.08 f up to 1250 Hz. A code is not a
sinusoid; each of its spectral lines is held against the limit on its own.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from tools.sim.light.transmitter import Lamp, code_bits

Array = npt.NDArray[np.float64]


def no_effect(frequency: Array) -> Array:
    """Largest modulation without observable effect, per cent."""
    return np.where(frequency < 90.0, 0.01 * frequency, np.where(frequency <= 3000.0, 0.0333 * frequency, np.inf))


def low_risk(frequency: Array) -> Array:
    """Largest modulation of low risk, per cent."""
    return np.where(frequency < 90.0, 0.025 * frequency, np.where(frequency <= 1250.0, 0.08 * frequency, np.inf))


def lines(lamp: Lamp, chip_rate: float, degree: int, manchester: bool = True) -> tuple[Array, Array]:
    """Frequencies (Hz) and modulations (per cent) of the lines of a lamp that repeats its frame for ever."""
    chips = 1.0 - 2.0 * np.array(code_bits(degree, lamp.code))
    signs = 1.0 - 2.0 * np.array([int(bit) for bit in lamp.frame()])
    halves = np.repeat(np.outer(signs, chips).ravel(), 2)
    if manchester:
        halves[1::2] *= -1.0
    n = len(halves)
    k = np.arange(1, n // 2)
    amplitude = 2.0 * np.abs(np.fft.rfft(halves)[k]) / n * np.sinc(k / n)  # steps, not samples
    return k * 2.0 * chip_rate / n, 100.0 * lamp.depth * amplitude


def worst(lamp: Lamp, chip_rate: float, degree: int, manchester: bool = True) -> float:
    """Largest modulation of any line over its no-effect limit; below 1 nobody sees or suffers anything."""
    frequency, modulation = lines(lamp, chip_rate, degree, manchester)
    return float(np.max(modulation / no_effect(frequency)))


BANDS = ((0.0, 90.0), (90.0, 1250.0), (1250.0, 3000.0))
"""Hz; above, the standard sets no limit."""

PROFILES = {"A": (5000.0, 7, 0.30), "B": (825.0, 6, 0.10), "D": (20_000.0, 9, 0.30)}
"""Chips per second, degree, depth; as in docs/air-interface.md."""


def table(name: str, data: bool) -> list[str]:
    """Markdown rows: of each band, the line that comes nearest to its limit, over a sample of the profile's codes."""
    chip_rate, degree, depth = PROFILES[name]
    every = 1 if degree < 9 and not data else 16
    lamps = [Lamp(code, 1.0, depth=depth, data=data) for code in range(0, 2**degree + 1, every)]
    spectra = [lines(lamp, chip_rate, degree) for lamp in lamps]
    frequency, modulation = spectra[0][0], np.max([spectrum[1] for spectrum in spectra], axis=0)
    rows = []
    for low, high in BANDS:
        inside = (frequency >= low) & (frequency < high)
        if inside.any():
            f, m = frequency[inside], modulation[inside]
            k = int(np.argmax(m / no_effect(f)))
            limits = f"{no_effect(f)[k]:.2f} | {low_risk(f)[k]:.2f}"
            what = f"{name}{', with frames' if data else ''}"
            rows.append(
                f"| {what} | {low:g} to {high:g} | {f[k]:.1f} | {m[k]:.3f} | {limits} | {m[k] / no_effect(f)[k]:.2f} |"
            )
    return rows


if __name__ == "__main__":
    print("| profile | band, Hz | worst line, Hz | modulation, % | no effect, % | low risk, % | of no effect |")
    print("|---|---|---|---|---|---|---|")
    for profile in PROFILES:
        for framed in (False, True):
            print("\n".join(table(profile, framed)))
