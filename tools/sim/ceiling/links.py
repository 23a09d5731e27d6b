"""From what is received to what a decoder reports: the link level, without samples.

The statistics are the decoder's own, measured on the waveform level; a test holds the two equal. A lamp must be seen
for a while before it is believed, a dark one is remembered for a second, and a frame takes three seconds to be heard.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.ceiling.ceiling import Ceiling

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

ELECTRON: Final = 1.602e-19
PERIOD_S: Final = 0.0503
"""From block to block: 50 ms of samples and the bus's overhead."""
EPOCH_S: Final = 0.05
FAINT_SIGMAS: Final = 4.0
CLEAR_SIGMAS: Final = 8.0
DIM: Final = 0.01
"""Of the strongest lamp: weaker ones are not taken up."""
ACQUIRE: Final = 4
"""Blocks until a lamp that has come into view is reported."""
GIVE_UP: Final = 20
"""Dark blocks until it is forgotten."""
HEARD: Final = 60
"""Blocks until a lamp has told what it is."""


@dataclass(frozen=True, slots=True)
class Reception:
    """Noise of front end, converter and decoder at profile A.

    Attributes:
        ambient_a: photocurrent of all light that carries no code. converter_a: noise of a 12 bit, 11.3 ENOB converter
            over 50 uA, per sample. thermal_a: of the amplifier. rate_hz: samples per second.
        efficiency: variance of an amplitude is noise^2 / (samples efficiency), with 16 lamps solved at once.
        reported: the same as the decoder reports it, which errs on the safe side.
        shape: relative error by template and timing.
        cross: error by lamps that shine but are not followed, whose codes are not quite orthogonal to the others: part
            of their amplitude (root of the sum of squares). cross_reported: what of it the decoder counts as noise.
    """

    ambient_a: float = 79e-6
    converter_a: float = 5.72e-9
    thermal_a: float = 0.1e-9
    rate_hz: float = 400e3 / 18
    efficiency: float = 0.72
    reported: float = 0.64
    shape: float = 1.5e-4
    cross: float = 0.045
    cross_reported: float = 0.031

    def sample_noise(self, lamps_a: float) -> float:
        """A per sample, under lamps of that mean photocurrent."""
        shot = ELECTRON * (self.ambient_a + lamps_a) * self.rate_hz
        return float(np.sqrt(self.converter_a**2 + self.thermal_a**2 + shot))


@dataclass(frozen=True, slots=True, eq=False)
class Report:
    """What is reported of one block; arrays have one element per link.

    Attributes:
        t_begin, t_end: of the block. lamp: row in the ceiling's lamps (only a simulator knows). amplitude, variance: A,
            A^2. faint: not significant any more. twin: two lamps of one code in view. told: has said what it is.
        truth: amplitude without error. noise_a: A per sample.
    """

    t_begin: float
    t_end: float
    lamp: Index
    amplitude: Array
    variance: Array
    faint: npt.NDArray[np.bool_]
    twin: npt.NDArray[np.bool_]
    told: npt.NDArray[np.bool_]
    truth: Array
    noise_a: float


class Links:
    """Turns amplitudes into reports, block after block.

    Args:
        ceiling: whose lamps. reception: noise. seed: of the noise.
    """

    def __init__(self, ceiling: Ceiling, reception: Reception | None = None, seed: int = 0) -> None:
        self._codes = np.array([lamp.code for lamp in ceiling.fixtures])
        self._depth, self._reception = ceiling.depth, reception or Reception()
        self._rng = np.random.default_rng((seed, 7))
        n = len(self._codes)
        self._clear, self._dark, self._heard = np.zeros(n, int), np.zeros(n, int), np.zeros(n, int)
        self._known = np.zeros(n, bool)

    def report(self, t_begin: float, t_end: float, amplitudes: Array) -> Report:
        """One block.

        Args:
            t_begin: s.
            t_end: s.
            amplitudes: (lamps,) A, true on average over the block.
        """
        noise = self._reception.sample_noise(float(amplitudes.sum()) / self._depth)
        rx = self._reception
        samples = (t_end - t_begin) * rx.rate_hz
        dim = ~self._known & (amplitudes < DIM * float(np.max(amplitudes, initial=0.0)))
        hidden = float(np.sum(amplitudes[dim] ** 2))
        sigma = np.sqrt(noise**2 / (samples * rx.efficiency) + rx.cross**2 * hidden)
        measured = amplitudes * (1.0 + rx.shape * self._rng.standard_normal(len(amplitudes)))
        measured = measured + sigma * self._rng.standard_normal(len(amplitudes))
        variance = noise**2 / (samples * rx.reported) + rx.cross_reported**2 * hidden
        faint = self._live_and_die(measured, float(np.sqrt(variance)))
        lamp = np.flatnonzero(self._known)
        codes, counts = np.unique(self._codes[lamp], return_counts=True)
        return Report(
            t_begin, t_end, lamp, measured[lamp], np.full(len(lamp), variance), faint[lamp],
            np.isin(self._codes[lamp], codes[counts > 1]), self._heard[lamp] >= HEARD, amplitudes[lamp], noise,
        )  # fmt: skip

    def _live_and_die(self, measured: Array, sigma: float) -> npt.NDArray[np.bool_]:
        """Which lamps are known after this block; returns which are faint."""
        clear = measured > max(CLEAR_SIGMAS * sigma, DIM * float(np.max(measured, initial=0.0)))
        faint = measured < FAINT_SIGMAS * sigma
        self._clear = np.where(clear, self._clear + 1, 0)
        self._dark = np.where(faint, self._dark + 1, 0)
        self._known |= self._clear >= ACQUIRE
        self._known &= self._dark < GIVE_UP
        self._heard = np.where(self._known, self._heard + ~faint, 0)
        return np.asarray(faint)
