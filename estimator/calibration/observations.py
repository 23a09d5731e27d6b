"""Calibration observations: RSS with pose and lamp, thinned to independent rows, and the lamp model at them.

A robot at rest for a minute adds no new information. There is therefore one row for each lamp, cell of the ground and
sector of headings. It is the median, which a passer-by does not shift.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.light_filter.lambertian import COLUMNS, expect
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

Index = npt.NDArray[np.int64]

CELL_M: Final = 0.10
"""Side of a thinning cell of the ground, m."""
SECTORS: Final = 8
"""Number of heading sectors."""
PATCH_M: Final = 2.0
"""Side of a patch of ground (m) in which model errors (walls, the lamp's own pattern) are correlated. In the light
filter they fade over the same path length.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Rows:
    """Received RSS; all arrays have one element (pose: one row) per observation.

    Attributes:
        pose: (n, 3) of the base (x, y, yaw) in the frame of the drive. lamp: (n,) index of the lamp.
        amplitude: RSS, A. sigma: one sigma of ln RSS from noise alone. t: s, for plots and for splitting a drive.

    Raises:
        ValueError: unequal lengths, values that are not finite, RSS not positive or noise negative.
    """

    pose: Array
    lamp: Index
    amplitude: Array
    sigma: Array
    t: Array

    def __post_init__(self) -> None:
        """Check lengths and values; raises ValueError."""
        n = len(self.lamp)
        shapes = [self.pose.shape == (n, 3), *(a.shape == (n,) for a in (self.amplitude, self.sigma, self.t))]
        if not all(shapes):
            raise ValueError(f"rows of unequal length: pose {self.pose.shape}, lamp {self.lamp.shape}")
        finite = np.isfinite(self.pose).all() and np.isfinite(self.amplitude).all() and np.isfinite(self.sigma).all()
        if not finite or (self.amplitude <= 0.0).any() or (self.sigma < 0.0).any():
            raise ValueError("poses must be finite, amplitudes positive and noise not negative")

    def __len__(self) -> int:
        """Number of observations."""
        return len(self.lamp)

    def chosen(self, which: npt.NDArray[np.bool_] | Index) -> Rows:
        """Subset of the rows, by mask or index."""
        return Rows(self.pose[which], self.lamp[which], self.amplitude[which], self.sigma[which], self.t[which])


def joined(parts: Sequence[Rows]) -> Rows:
    """Concatenation of several parts."""
    fields = zip(*((p.pose, p.lamp, p.amplitude, p.sigma, p.t) for p in parts), strict=True)
    pose, lamp, amplitude, sigma, t = (np.concatenate(list(field)) for field in fields)
    return Rows(pose, lamp, amplitude, sigma, t)


def thinned(rows: Rows, cell: float = CELL_M) -> Rows:
    """One row per lamp, cell of the ground (side ``cell``, m) and heading sector: that of the median RSS."""
    if not len(rows):
        return rows
    sector = np.floor((rows.pose[:, 2] / (2.0 * np.pi) % 1.0) * SECTORS)
    keys = np.column_stack((rows.lamp, np.floor(rows.pose[:, :2] / cell), sector)).astype(np.int64)
    order = np.lexsort((rows.amplitude, *keys.T))
    ordered = keys[order]
    begins = np.flatnonzero(np.r_[True, (ordered[1:] != ordered[:-1]).any(axis=1)])
    counts = np.diff(np.r_[begins, len(order)])
    middle = order[begins + (counts - 1) // 2]
    found = rows.chosen(np.sort(middle))
    return found


def patches(pose: Array, lamp: Index, size: float = PATCH_M) -> Index:
    """(n,) number of the patch of each row (lamp and square of ground); rows of one patch share their model error."""
    keys = np.column_stack((lamp, np.floor(pose[:, :2] / size))).astype(np.int64)
    numbers: Index = np.unique(keys, axis=0, return_inverse=True)[1].reshape(-1).astype(np.int64)
    return numbers


@kernel("void(f8[:, ::1], i8[::1], f8[::1], f8[:, ::1], f8, Tuple((f8[:, ::1], f8[:, ::1])))")
def expect_rows(lamps: Array, which: Index, rx: Array, poses: Array, floor: float, said: tuple[Array, Array]) -> None:
    """`lambertian.expect` for one lamp and one pose per row; fills ``said``: values (n, 3), Jacobian (n, 17)."""
    out, J = said
    for i in range(which.shape[0]):
        expect(lamps[which[i]], rx, poses[i], floor, out[i], J[i])


def model(lamps: Array, rx: Array, rows_pose: Array, which: Index, floor: float) -> tuple[Array, Array]:
    """Expected RSS per row: (n, 3) of RSS (A), direct part (A), cos(beta); and the (n, 17) Jacobian of ln RSS."""
    n = len(which)
    out, J = np.zeros((n, 3)), np.zeros((n, COLUMNS))
    expect_rows(lamps, which, rx, np.ascontiguousarray(rows_pose), floor, (out, J))
    some = out[:, 0] > 0.0
    J[some] /= out[some, 0, None]
    J[~some] = 0.0
    return out, J
