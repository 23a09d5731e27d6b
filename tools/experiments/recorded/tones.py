"""Six lamps as tones in a recorded photodiode stream, all demodulated by the decoder's joint least squares.

The lamps are switched on and off, so each tone brings its harmonics, and at 2 kHz these fold back among the other
tones: 3 x 735 Hz appears at 205 Hz, 3 x 215 Hz at 645 Hz and 9 x 865 Hz at 214.7 Hz, beside the tones of 215 and
640 Hz. A tone's column is therefore the lamp's whole folded waveform (a square wave at first, then learnt from the
recording's first seconds), as the column of a coded lamp is its whole pulse train; with it go the derivative by phase
and the subspace of offset, drift and mains.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from estimator.cdma.correlation_kernels import invert
from estimator.cdma.data_bits import stacked
from estimator.cdma.joint_fit_kernels import reduce_rows
from estimator.cdma.mains_rejection import basis, orthonormal
from estimator.cdma.sample_block import Sampled
from tools.ci.figures import Figure
from tools.experiments.recorded import vlp
from tools.experiments.recorded.vlp import Array, Raw
from tools.experiments.support.report import COMMAND, Cell, Picture, Report, Table, Work

HARMONICS: Final = (1, 2, *range(3, 42, 2))
"""Lamps switched with equal on and off times have odd harmonics; the second shows how equal these are."""
FLICKER_HZ: Final = 100.0
MAINS_HARMONICS: Final = 3
TRACK_S: Final = 0.2
LEARN_S: Final = 16.0
ROUNDS: Final = 3
"""Of learning waveforms at tracked phases and tracking phases by learnt waveforms; a fourth changes nothing."""
EPOCHS_S: Final = (0.05, 0.2, 1.0)
REST_S: Final = ((0.5, 18.0), (58.0, 79.0))
"""Parts of the recording in which the mean light, and so the receiver, stands still."""
PULL: Final = 0.5
FOLLOW: Final = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Solved:
    """Unknowns, their variances and the noise per sample (converter steps)."""

    found: Array
    variance: Array
    noise_var: float


def joint(y: Array, rows: Array, rate: float) -> Solved:
    """Least squares of all rows together, offset, drift and mains eliminated, by the decoder's solver."""
    at = np.arange(len(y), dtype=np.float64)
    q = orthonormal(basis(at, FLICKER_HZ / rate, MAINS_HARMONICS))[0]
    stack = stacked(Sampled(y, at, np.ones_like(y), q), len(rows))
    stack[: len(rows)] = rows
    normal, right = np.empty((len(rows), len(rows))), np.empty(len(rows))
    extent = np.zeros((2, len(stack)), np.int64)
    extent[1] = len(y)
    power = reduce_rows(stack, extent, len(rows), normal, right)
    normal[np.diag_indices(len(rows))] *= 1.0 + 1e-9
    invert(normal)
    found = normal @ right
    freedom = max(len(y) - len(q) - len(rows), 1)
    noise_var = max(power - float(right @ found), 1e-30) / freedom
    return Solved(found, noise_var * np.maximum(normal.diagonal(), 0.0), noise_var)


def square() -> Array:
    """Harmonics of a lamp that is on for half of the time, relative to its fundamental."""
    shape: Array = np.array([0.0 if k % 2 == 0 else (-1.0) ** (k // 2) / k for k in HARMONICS])
    return shape


def demodulated(raw: Raw, rounds: int = ROUNDS) -> tuple[Array, list[Array]]:
    """Phases (tones, N) in cycles and waveforms of all lamps of a stream."""
    shapes = [square() for _ in raw.tones]
    for _ in range(rounds):
        shapes = learnt(raw, tracked(raw, shapes))
    return tracked(raw, shapes), shapes


def waveform(cycles: Array, shape: Array) -> tuple[Array, Array]:
    """A lamp's signal at amplitude 1 of its fundamental, and its derivative by phase (radians).

    ``shape``: complex amplitudes of `HARMONICS` with the first 1 (a cosine), or of fewer of them.
    """
    value, slope = np.zeros(len(cycles)), np.zeros(len(cycles))
    for k, part in zip(HARMONICS[: len(shape)], shape, strict=True):
        wave = part * np.exp(2j * np.pi * k * cycles)
        value += wave.real
        slope -= k * wave.imag
    return value, slope


def tracked(raw: Raw, shapes: list[Array]) -> Array:
    """(tones, N) phase of each tone at each sample, cycles: a second-order loop over short epochs."""
    step = int(TRACK_S * raw.rate)
    n = len(raw.words) // step * step
    tones = np.array(raw.tones) / raw.rate
    phase, turn = _begin(raw, step), tones.copy()
    knots = []
    for begin in range(0, n, step):
        at = np.arange(step)
        pairs = [waveform(p + f * at, s) for p, f, s in zip(phase, turn, shapes, strict=True)]
        rows = np.array([p[0] for p in pairs] + [p[1] for p in pairs])
        solved = joint(raw.words[begin : begin + step], rows, raw.rate)
        strength, quadrature = np.split(solved.found, 2)
        clear = np.abs(strength) > 5.0 * np.sqrt(solved.variance[: len(tones)])
        off = np.where(clear, np.arctan2(quadrature, np.maximum(strength, 1e-9)), 0.0) / (2.0 * np.pi)
        knots.append(phase + turn * (0.5 * step) + off)
        turn += FOLLOW * off / step
        phase += turn * step + PULL * off
    at = np.arange(len(raw.words))
    where = (np.arange(len(knots)) + 0.5) * step
    base = np.outer(tones, where)
    return np.array([
        tones[i] * at + np.interp(at, where, np.array(knots)[:, i] - base[i]) for i in range(len(tones))
    ])  # fmt: skip


def _begin(raw: Raw, step: int) -> Array:
    """Phases at the first sample, from the first epoch's cosines and sines."""
    at = np.arange(step)
    waves = [np.exp(2j * np.pi * tone / raw.rate * at) for tone in raw.tones]
    rows = np.array([w.real for w in waves] + [w.imag for w in waves])
    cosine, sine = np.split(joint(raw.words[:step], rows, raw.rate).found, 2)
    phase: Array = np.arctan2(-sine, cosine) / (2.0 * np.pi)
    return phase


def learnt(raw: Raw, cycles: Array) -> list[Array]:
    """Each lamp's harmonics relative to its fundamental, all lamps jointly over the recording's first seconds.

    One long solution, because folded harmonics of different lamps come as close as 0.3 Hz.
    """
    part, tones = slice(0, int(LEARN_S * raw.rate)), len(raw.tones)
    waves = [np.exp(2j * np.pi * k * row) for row in cycles[:, part] for k in HARMONICS]
    rows = np.array([w.real for w in waves] + [-w.imag for w in waves])
    real, imag = np.split(joint(raw.words[part], rows, raw.rate).found, 2)
    found = (real + 1j * imag).reshape(tones, len(HARMONICS))
    # the fundamental becomes a cosine of its own phase: harmonic k turns by k times its angle
    turn = np.exp(-1j * np.angle(found[:, :1]) * np.array(HARMONICS))
    return list(found * turn / np.abs(found[:, :1]))


Rows = Callable[[Array, list[Array]], tuple[Array, Callable[[Array], Array]]]


def by_waveform(cycles: Array, shapes: list[Array]) -> tuple[Array, Callable[[Array], Array]]:
    """Whole waveforms and their derivatives: two rows a lamp."""
    pairs = [waveform(c, s) for c, s in zip(cycles, shapes, strict=True)]
    rows = np.array([p[0] for p in pairs] + [p[1] for p in pairs])
    return rows, lambda found: found[: len(cycles)]


def by_sinusoid(cycles: Array, shapes: list[Array]) -> tuple[Array, Callable[[Array], Array]]:
    """Fundamentals only, cosine and sine."""
    waves = np.exp(2j * np.pi * cycles)
    return np.concatenate((waves.real, waves.imag)), _length(len(cycles))


def by_harmonics(cycles: Array, shapes: list[Array]) -> tuple[Array, Callable[[Array], Array]]:
    """Fundamentals, third and fifth harmonics, each with a cosine and a sine of its own: six rows a lamp."""
    waves = np.concatenate([np.exp(2j * np.pi * k * cycles) for k in (1, 3, 5)])
    return np.concatenate((waves.real, waves.imag)), _length(len(cycles))


def _length(tones: int) -> Callable[[Array], Array]:
    return lambda found: np.hypot(found[:tones], found[len(found) // 2 : len(found) // 2 + tones])


METHODS: Final[dict[str, Rows]] = {
    "joint, folded waveforms": by_waveform,
    "joint, free harmonics 1, 3, 5": by_harmonics,
    "joint, fundamentals only": by_sinusoid,
}
ONE_BY_ONE: Final = "each tone by itself"


def amplitudes(raw: Raw, cycles: Array, shapes: list[Array], seconds: float, method: str) -> tuple[Array, Array]:
    """(epochs, tones) amplitudes and their predicted standard deviations, converter steps."""
    step = int(seconds * raw.rate)
    values, sigmas = [], []
    for begin in range(0, len(raw.words) - step + 1, step):
        y, part = raw.words[begin : begin + step], cycles[:, begin : begin + step]
        if method == ONE_BY_ONE:
            lock = np.exp(-2j * np.pi * part)
            values.append(2.0 * np.abs(lock @ (y - y.mean())) / step)
            sigmas.append(np.full(len(part), np.nan))
            continue
        rows, strength = METHODS[method](part, shapes)
        solved = joint(y, rows, raw.rate)
        values.append(strength(solved.found))
        sigmas.append(np.sqrt(solved.variance[: len(part)]))
    return np.array(values), np.array(sigmas)


def noise(values: Array, seconds: float) -> Array:
    """Relative noise per epoch and tone while the receiver stands still, per cent; slow drift does not count."""
    t = (np.arange(len(values)) + 0.5) * seconds
    squares, level = [], []
    for begin, end in REST_S:
        part = values[(t > begin) & (t < end)]
        squares.append(np.diff(part, 2, axis=0) ** 2 / 6.0)
        level.append(part)
    percent: Array = 100.0 * np.sqrt(np.mean(np.concatenate(squares), axis=0)) / np.mean(np.concatenate(level), axis=0)
    return percent


def run(quick: bool, work: Work) -> Report:
    """Demodulate the recording at several epoch lengths and report the noise per epoch of each tone."""
    raw = vlp.raw()
    cycles, shapes = demodulated(raw)
    lengths = EPOCHS_S[1:2] if quick else EPOCHS_S
    order = np.argsort(raw.tones)
    rows: list[tuple[Cell, ...]] = []
    figures, series = [], {}
    for seconds in lengths:
        for method in (*METHODS, ONE_BY_ONE):
            values, sigmas = amplitudes(raw, cycles, shapes, seconds, method)
            percent = noise(values, seconds)
            rows.append((f"{1e3 * seconds:g} ms, {method}", *(float(percent[i]) for i in order)))
            if method == next(iter(METHODS)):
                series[seconds] = values
                predicted = 100.0 * np.nanmedian(sigmas / values, axis=0)
                rows.append((f"{1e3 * seconds:g} ms, predicted by the solver", *(float(predicted[i]) for i in order)))
                name = f"noise of six tones in {1e3 * seconds:g} ms epochs"
                figures += [
                    Figure(f"{name}, median", float(np.median(percent)), "%", command=f"{COMMAND} tones"),
                    Figure(f"{name}, worst", float(percent.max()), "%", command=f"{COMMAND} tones"),
                ]
    head = ("epoch, method", *(f"{raw.tones[i]:g} Hz" for i in order))
    third: list[tuple[Cell, ...]] = [
        (f"harmonic {k}", *(float(abs(shapes[i][j])) for i in order)) for j, k in enumerate(HARMONICS) if 1 < k < 14
    ]
    tables = (
        Table("relative noise of the amplitudes at rest, %", head, tuple(rows)),
        Table("learnt waveforms: harmonics relative to the fundamental", ("", *head[1:]), tuple(third)),
    )
    notes = ("at rest: the first 18 s and the last 21 s; motion between them is in the picture but not in the figures",)
    return Report(tuple(figures), tables, (Picture("tones", _drawing(raw, series)),), (), notes)


def _drawing(raw: Raw, series: dict[float, Array]) -> Callable[[Any], None]:
    def draw(canvas: Any) -> None:
        axes = canvas.subplots()
        seconds = sorted(series)[min(1, len(series) - 1)]
        t = (np.arange(len(series[seconds])) + 0.5) * seconds
        for tone, row in zip(raw.tones, series[seconds].T, strict=True):
            axes.plot(t, row, label=f"{tone:g} Hz", linewidth=1.0)
        axes.set(xlabel="time, s", ylabel="amplitude, converter steps", title=f"six lamps, {1e3 * seconds:g} ms epochs")
        axes.legend(ncols=3, fontsize="small")
        axes.grid(alpha=0.3)

    return draw
