"""Repairs stamps that do not increase, so that a log can be played in file order.

Two defects are distinguished. *Scatter*: small backward steps, because several processes or a later reconstruction
wrote the stamps. The file order is right and the stamps are noisy; the time is the least-squares increasing sequence
(isotonic regression). *A restarted clock*: a step that is too large for scatter, or that lasts. The
following stamps are shifted so that they continue the log. The records keep their original stamps.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

BACK_S: Final = 5.0
"""A step back by more than this is a restarted clock, not scatter (real logs scatter by up to about a second)."""

LASTS: Final = 8
"""Stamps in a row, before and after a smaller step back, that are displaced by it if a clock was set."""

AHEAD_S: Final = 3600.0
"""A forward step by more than this is a clock that was set."""

GAP_S: Final = 1e-3
"""Least interval of two records of one stream; a scan takes longer."""


@dataclass(frozen=True, slots=True, eq=False)
class Monotone:
    """Repaired time of one stream.

    Attributes:
        time: seconds, strictly increasing, starting near 0.
        backward: steps back in the original stamps. worst_s: the largest of them, without restarts.
        duplicates: steps of exactly zero. restarts: clock restarts and settings that were bridged.
    """

    time: Array
    backward: int
    worst_s: float
    duplicates: int
    restarts: int


def monotone(stamps: Array, origin: float) -> Monotone:
    """Strictly increasing time for ``stamps`` (seconds, file order), counted from ``origin`` seconds.

    Equal to ``stamps - origin`` wherever the stamps already increase by at least :data:`GAP_S` undisturbed.
    """
    steps = np.diff(stamps)
    restart = (steps < -BACK_S) | (steps > AHEAD_S) | _set_back(stamps)
    bridged, restarts = _bridge(stamps - origin, restart)
    back = steps[(steps < 0.0) & ~restart]
    return Monotone(
        time=_spaced(_isotonic(bridged)),
        backward=len(back),
        worst_s=float(-back.min()) if len(back) else 0.0,
        duplicates=int(np.count_nonzero(steps == 0.0)),
        restarts=restarts,
    )


def _set_back(stamps: Array) -> npt.NDArray[np.bool_]:
    """Steps back that last: :data:`LASTS` stamps before and after the step overlap, each side in order.

    Scatter displaces a few stamps; a clock that was set displaces all that follow.
    """
    steps = np.diff(stamps)
    found = np.zeros(len(steps), np.bool_)
    for k in np.flatnonzero(steps < 0.0):
        before, after = stamps[max(0, k + 1 - LASTS) : k + 1], stamps[k + 1 : k + 1 + LASTS]
        if len(before) == len(after) == LASTS and before[0] > after[-1]:
            found[k] = bool(np.all(np.diff(before) >= 0.0) and np.all(np.diff(after) >= 0.0))
    return found


def _bridge(stamps: Array, restart: npt.NDArray[np.bool_]) -> tuple[Array, int]:
    """Shift the stamps after each restart to one usual step after their predecessor."""
    count = int(np.count_nonzero(restart))
    if count == 0:
        return stamps, 0
    steps = np.diff(stamps)
    usual = float(np.median(steps[~restart])) if count < len(steps) else GAP_S
    steps[restart] = max(usual, GAP_S)
    return np.concatenate([stamps[:1], stamps[0] + np.cumsum(steps)]), count


def _isotonic(stamps: Array) -> Array:
    """Isotonic regression by pooling adjacent violators; a pool is then spread evenly towards its neighbours.

    Without the spreading several scans would share one instant, with infinite velocities. Each result lies between the
    largest stamp before it and the smallest after it: no time moves further than the disorder.
    """
    if np.all(np.diff(stamps) > 0.0):
        return stamps
    means: list[float] = []
    sizes: list[int] = []
    for stamp in stamps.tolist():
        mean, size = stamp, 1
        while means and means[-1] >= mean:
            last, count = means.pop(), sizes.pop()
            mean, size = (last * count + mean * size) / (count + size), count + size
        means.append(mean)
        sizes.append(size)
    ends = np.cumsum(sizes)
    centres = ends - (np.asarray(sizes) + 1) / 2.0
    spread = np.interp(np.arange(len(stamps)), centres, means)
    return np.clip(spread, np.minimum.accumulate(stamps[::-1])[::-1], np.maximum.accumulate(stamps))


def _spaced(time: Array) -> Array:
    """Keep at least :data:`GAP_S` between neighbours (the ends of a pool at a log's edge are one instant)."""
    if np.all(np.diff(time) >= GAP_S):
        return time
    ramp = GAP_S * np.arange(len(time))
    return np.asarray(np.maximum.accumulate(time - ramp) + ramp)
