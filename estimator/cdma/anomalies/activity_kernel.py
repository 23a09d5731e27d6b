"""Kernel of the activity of samples: how much each window of a block bends."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from estimator.numerics.jit import kernel

F8 = npt.NDArray[np.float64]


@kernel("f8(f8[::1], i8, f8[::1])")
def activity(words: F8, window: int, out: F8) -> float:
    """Mean square of the second differences in each window, over that of white noise of unit variance.

    Returns the smallest.

    Args:
        words: (N,) samples.
        window: samples of each window.
        out: (W,) out; ``W * window + 2`` samples are read.
    """
    least = np.inf
    for k in range(out.shape[0]):
        total = 0.0
        for n in range(k * window, (k + 1) * window):
            bend = words[n] - 2.0 * words[n + 1] + words[n + 2]
            total += bend * bend
        out[k] = total / (6.0 * window)
        least = min(least, out[k])
    return least
