"""Lidar information on the position at a place: Fisher information of ranges to walls (Censi, ICRA 2007).

A beam that meets a wall with normal n measures the position along n. Neighbouring beams have common errors, and so do a
wall and its map. A beam therefore counts with :data:`BEAM_SIGMA_M`: three that agree make an axis known, one does not.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy import ndimage

from daemon.commissioning.floor import Array, Hall, Mask

Index = npt.NDArray[np.int64]

BEAMS: Final = 120
REACH_M: Final = 10.0
BEAM_SIGMA_M: Final = 0.15
KNOWN_SIGMA_M: Final = 0.10
"""An axis with a larger sigma, m, is not known; the same as `estimator.result.KNOWN`."""
STEEPEST: Final = 0.3
"""Smallest usable cosine between a beam and a wall's normal; beams that graze a wall more are unreliable."""
_FINE_CELLS, _COARSE_CELLS = 0.7, 1.5
_CHUNK: Final = 400


def wall_information(hall: Hall, reach: float = REACH_M) -> Array:
    """Returns the information (n, 3) xx, xy, yy at every place, 1/m^2."""
    nx, ny = _normals(hall)
    angle = np.linspace(-math.pi, math.pi, BEAMS, endpoint=False)
    ux, uy = np.cos(angle), np.sin(angle)
    info = np.zeros((len(hall.places), 3))
    for begin in range(0, len(hall.places), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        row, column, hit = _cast(hall, hall.places[part], ux, uy, reach)
        a, b = nx[row, column], ny[row, column]
        facing = np.abs(a * ux + b * uy)
        weight = np.where(hit & (facing > STEEPEST), 1.0 / (BEAM_SIGMA_M * np.maximum(facing, STEEPEST)) ** 2, 0.0)
        info[part] = np.column_stack([(weight * p).sum(axis=1) for p in (a * a, a * b, b * b)])
    return info


def _normals(hall: Hall) -> tuple[Array, Array]:
    """Returns unit normals of solid cells, up to their sign, by the structure tensor, which suits thin walls too."""
    smooth = ndimage.gaussian_filter(hall.solid.astype(np.float64), _FINE_CELLS)
    gy, gx = np.gradient(smooth)
    xx, xy, yy = (ndimage.gaussian_filter(part, _COARSE_CELLS) for part in (gx * gx, gx * gy, gy * gy))
    angle = 0.5 * np.arctan2(2.0 * xy, xx - yy)
    return np.cos(angle), np.sin(angle)


def _cast(hall: Hall, places: Array, ux: Array, uy: Array, reach: float) -> tuple[Index, Index, Mask]:
    """Returns the first solid cell along each beam: rows, columns (p, beams), and whether there was one."""
    x, y = places[:, :1] / hall.cell, places[:, 1:] / hall.cell
    rows, columns = hall.solid.shape
    row, column = (np.zeros((len(places), len(ux)), np.int64) for _ in range(2))
    hit = np.zeros(row.shape, np.bool_)
    flying = np.ones(row.shape, np.bool_)
    for step in np.arange(0.0, reach / hall.cell, 0.7):
        c, r = (x + step * ux).astype(np.int64), (y + step * uy).astype(np.int64)
        inside = (r >= 0) & (r < rows) & (c >= 0) & (c < columns)
        flying &= inside
        if not flying.any():
            break
        met = flying & hall.solid[np.clip(r, 0, rows - 1), np.clip(c, 0, columns - 1)]
        row[met], column[met] = r[met], c[met]
        hit |= met
        flying &= ~met
    return row, column, hit
