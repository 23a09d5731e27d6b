"""Repairs stamps that do not increase, so that a log can be played in file order.

Three defects are distinguished. *Scatter*: small backward steps, because several processes or a later reconstruction
wrote the stamps. The file order is right and the stamps are noisy; the time is the least-squares increasing sequence
(isotonic regression). *A clock that was set*: a backward step that lasts, or one too large for scatter. The following
stamps are shifted so that they continue the log. *A coarse clock*, of whole seconds for example: many stamps equal
the one before. Records of one stamp are spread evenly until the clock's next step. The records keep their original
stamps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

BACK_S: Final = 5.0
"""A step back by more than this is a clock that was set, not scatter (real logs scatter by up to about a second)."""

SCATTER_S: Final = 1.0
"""Smallest step back, s, that can be a clock that was set in a log whose stamps scatter."""

SCATTERED: Final = 0.01
"""Share of backward steps above which the stamps of a log scatter."""

LASTS: Final = 10
"""Records before and after a step back whose median stamps decide whether it lasts."""

_JUDGED: Final = 3
"""Records on each side without which a step back counts as scatter."""

FALL: Final = 0.6
"""Fall of these medians, as a share of the step back, from which on it lasts."""

AHEAD_S: Final = 3600.0
"""A forward step by more than this is a clock that was set."""

GAP_S: Final = 1e-3
"""Least interval of two records of one stream; a scan takes longer."""

COARSE: Final = 0.1
"""Share of equal neighbours above which the clock of the stamps is coarse."""

_FEW_EQUAL: Final = 3
"""Equal neighbours that any clock may have."""

FASTEST_S, SLOWEST_S = 5e-3, 60.0
"""Usual interval of two scans, s: no lidar is faster, and larger steps are no seconds."""

CLOCK_CHANGES: Final = 0.1
"""Share of steps, at most, at which a clock can have been set."""


@dataclass(frozen=True, slots=True, eq=False)
class Monotone:
    """Repaired time of one stream.

    Attributes:
        time: seconds, strictly increasing, starting near 0.
        backward: steps back in the original stamps. worst_s: the largest of them, without restarts.
        duplicates: steps of exactly zero. restarts: clock restarts and settings that were bridged.
        coarse_s: step of a coarse clock, s; 0: the clock is fine enough.
        wild: single stamps far from both neighbours, which agree; replaced by their middle.
    """

    time: Array
    backward: int
    worst_s: float
    duplicates: int
    restarts: int
    coarse_s: float = 0.0
    wild: int = 0

    @property
    def refusal(self) -> str:
        """Why the stamps give no time to play scans at; empty if they do."""
        count = len(self.time) - 1
        if count < 1:
            return ""
        usual = float(np.median(np.diff(self.time)))
        if self.duplicates == count:
            return f"all {count + 1} stamps are equal"
        if self.restarts > max(2.0, CLOCK_CHANGES * count):
            return f"the clock jumps at {self.restarts} of {count} stamps"
        if usual < FASTEST_S:
            return f"too few stamps are later than the one before: {self.duplicates} equal it, {self.backward} run back"
        if usual > SLOWEST_S:
            return f"the stamps lie {usual:.0f} s apart and cannot be seconds"
        return ""


def monotone(stamps: Array, origin: float) -> Monotone:
    """Strictly increasing time for ``stamps`` (seconds, file order), counted from ``origin`` seconds.

    Equal to ``stamps - origin`` wherever the stamps already increase by at least :data:`GAP_S` undisturbed.
    """
    stamps, wild = _tamed(stamps)
    steps = np.diff(stamps)
    duplicates = int(np.count_nonzero(steps == 0.0))
    coarse = max(_FEW_EQUAL, COARSE * len(steps)) < duplicates < len(steps)
    restart = (steps < -BACK_S) | (steps > AHEAD_S) | _set_back(stamps, steps)
    bridged, restarts = _bridge(stamps - origin, restart, coarse)
    back = steps[(steps < 0.0) & ~restart]
    levels = _pooled(bridged) if coarse else bridged
    resolution = _resolution(np.diff(levels)) if coarse else 0.0
    return Monotone(
        time=_spaced(_spread_runs(levels, resolution) if resolution > 0.0 else _isotonic(bridged)),
        backward=len(back),
        worst_s=float(-back.min()) if len(back) else 0.0,
        duplicates=duplicates,
        restarts=restarts,
        coarse_s=resolution,
        wild=wild,
    )


def _tamed(stamps: Array) -> tuple[Array, int]:
    """Replace each single stamp that lies far from both neighbours, which agree, by their middle; and their number."""
    if len(stamps) < 3:
        return stamps, 0
    steps = np.diff(stamps)
    forward = steps[(steps > 0.0) & (steps <= AHEAD_S)]
    usual = float(np.median(forward)) if len(forward) else GAP_S
    far = (steps[:-1] * steps[1:] < 0.0) & (np.minimum(np.abs(steps[:-1]), np.abs(steps[1:])) > SCATTER_S)
    across = stamps[2:] - stamps[:-2]
    wild = 1 + np.flatnonzero(far & (across > 0.0) & (across <= _AGREE * usual))
    if not len(wild):
        return stamps, 0
    tamed = stamps.copy()
    tamed[wild] = 0.5 * (stamps[wild - 1] + stamps[wild + 1])
    return tamed, len(wild)


_AGREE: Final = 4.0
"""Longest interval, in usual ones, of two stamps that agree about the one between them."""


def _set_back(stamps: Array, steps: Array) -> Flags:
    """Which steps, (n - 1,), are steps back that last: the stamps after one continue from the lower level.

    After a stamp that is wrong by itself, or among stamps that scatter, the medians on both sides agree.
    """
    lasting = np.zeros(len(steps), dtype=bool)
    backward = np.flatnonzero(steps < 0.0)
    if not len(backward):
        return lasting
    usual, ahead = _rate(stamps), steps[(steps > 0.0) & (steps <= AHEAD_S)]
    scatters = len(backward) > SCATTERED * len(steps)
    least = max(2.0 * float(np.median(ahead)) if len(ahead) else 0.0, SCATTER_S if scatters else 0.0)
    for at in backward[-steps[backward] >= least].tolist():
        before, after = stamps[max(0, at + 1 - LASTS) : at + 1], stamps[at + 1 : at + 1 + LASTS]
        if min(len(before), len(after)) < _JUDGED:
            continue
        before, after = before + usual * np.arange(len(before), 0, -1), after - usual * np.arange(len(after))
        lasting[at] = np.median(before) - np.median(after) >= -FALL * steps[at]
    return lasting


def _rate(stamps: Array) -> float:
    """Usual interval of two records, s, whatever a few of them have: the median over many records."""
    many = max(1, min(2 * LASTS, len(stamps) // 2))
    return max(0.0, float(np.median(stamps[many:] - stamps[:-many])) / many)


def _bridge(stamps: Array, restart: Flags, coarse: bool) -> tuple[Array, int]:
    """Shift the stamps after each restart to one usual step after their predecessor."""
    count = int(np.count_nonzero(restart))
    if count == 0:
        return stamps, 0
    steps = np.diff(stamps)
    usual = float(np.median(steps[~restart])) if count < len(steps) else GAP_S
    steps[restart] = _coarse_steps(steps, restart) if coarse else max(usual, GAP_S)
    return np.concatenate([stamps[:1], stamps[0] + np.cumsum(steps)]), count


def _coarse_steps(steps: Array, restart: Flags) -> Array:
    """Steps that bridge the restarts of a coarse clock: 0 within one of its steps, else one step.

    Records on both sides are within one step if they are no more than a step usually has.
    """
    changes = np.flatnonzero(steps != 0.0)
    sizes = np.diff(changes, prepend=-1, append=len(steps))  # records of each run of equal stamps
    at = np.searchsorted(changes, np.flatnonzero(restart))
    together = sizes[at] + sizes[at + 1] <= 1.5 * np.median(sizes)
    return np.where(together, 0.0, _resolution(steps[~restart]))


def _resolution(steps: Array) -> float:
    """Usual step of a coarse clock, s; 0 if it makes none."""
    return float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 0.0


def _spread_runs(levels: Array, resolution: float) -> Array:
    """Spread each run of equal stamps over one step of the clock, at most until its next step.

    A log may begin and end within a step of the clock. The first run therefore ends, and the last one begins, with it.
    """
    first = np.flatnonzero(np.diff(levels, prepend=-np.inf) > 0.0)
    sizes = np.diff(first, append=len(levels))
    lengths = np.minimum(np.diff(levels[first], append=np.inf), resolution)
    usual = float(np.median(sizes))
    begin = levels[first].copy()
    for run in (0, -1):
        whole = lengths[run]
        lengths[run] = min(whole, whole * sizes[run] / usual)
        begin[run] += (whole - lengths[run]) if run == 0 else 0.0
    within = np.arange(len(levels)) - np.repeat(first, sizes)
    spread = np.repeat(begin, sizes) + within * np.repeat(lengths / sizes, sizes)
    pauses = 1 + np.flatnonzero(np.diff(levels) > 1.5 * resolution)
    reach = int(_SMOOTHED * usual)
    return np.concatenate([_averaged(part, reach) for part in np.split(spread, pauses)])


_SMOOTHED: Final = 2.0
"""Steps of a coarse clock, before and after a record, over which its interval is averaged."""


def _averaged(times: Array, reach: int) -> Array:
    """Mean of the times of the ``reach`` records on each side; towards the ends at the mean interval there.

    A step of the clock contains one record more or less than the next one; their mean interval is nearer the truth.
    """
    reach = min(reach, (len(times) - 1) // 2)
    if reach < 1:
        return times
    window = 2 * reach + 1
    sums = np.concatenate([[0.0], np.cumsum(times - times[0])])
    middle = times[0] + (sums[window:] - sums[:-window]) / window
    from_end = np.arange(reach, 0, -1)
    before = middle[0] - from_end * (times[window - 1] - times[0]) / (window - 1)
    after = middle[-1] + from_end[::-1] * (times[-1] - times[-window]) / (window - 1)
    return np.concatenate([before, middle, after])


def _isotonic(stamps: Array) -> Array:
    """Isotonic regression by pooling adjacent violators; a pool is then spread evenly towards its neighbours.

    Without the spreading several scans would share one instant, with infinite velocities. Each result lies between the
    largest stamp before it and the smallest after it: no time moves further than the disorder.
    """
    if np.all(np.diff(stamps) > 0.0):
        return stamps
    means, sizes = _pools(stamps)
    ends = np.cumsum(sizes)
    centres = ends - (np.asarray(sizes) + 1) / 2.0
    spread = np.interp(np.arange(len(stamps)), centres, means)
    return np.clip(spread, np.minimum.accumulate(stamps[::-1])[::-1], np.maximum.accumulate(stamps))


def _pooled(stamps: Array) -> Array:
    """Isotonic regression: the least-squares sequence that never decreases."""
    means, sizes = _pools(stamps)
    return np.repeat(means, sizes)


def _pools(stamps: Array) -> tuple[list[float], list[int]]:
    """Means and sizes of the pools of adjacent violators, in order."""
    means: list[float] = []
    sizes: list[int] = []
    for stamp in stamps.tolist():
        mean, size = stamp, 1
        while means and means[-1] >= mean:
            last, count = means.pop(), sizes.pop()
            mean, size = (last * count + mean * size) / (count + size), count + size
        means.append(mean)
        sizes.append(size)
    return means, sizes


def _spaced(time: Array) -> Array:
    """Keep at least :data:`GAP_S` between neighbours (the ends of a pool at a log's edge are one instant)."""
    if np.all(np.diff(time) >= GAP_S):
        return time
    ramp = GAP_S * np.arange(len(time))
    return np.asarray(np.maximum.accumulate(time - ramp) + ramp)
