"""Light information on the position at a place, from each received lamp: Eq. 1, its derivative, and its uncertainties.

Lamp and receiver are level. The gradient of ln of the RSS is then -(m_t + m_r + 2) (p - l) / d^2 (Eq. 7). Its variance
is that of `estimator.paper.lateration_model.usable`. It contains the lamp's own power, the tilt of ceiling and robot,
and light by way of walls. All links share the receiver's gain. The Sherman-Morrison formula eliminates it, so that the
information of lamps at a place adds up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.commissioning.floor import Array, Hall, clear

SHARED_LN, TILT, BY_WALLS = 0.05, 0.015, 0.008
"""As in `lateration_model.Doubt`: common gain of all links, tilt (rad), and the lamp's own diffuse part."""
RIM: Final = 0.97
"""Share of the radius of the field of view in which a lamp counts: at its edge a tilted robot loses the lamp."""


@dataclass(frozen=True, slots=True)
class Fitting:
    """Parameters of lamp and receiver.

    Attributes:
        height: of lamps above the receiver, m. order: Lambert order of the lamps plus that of the receiver.
        half_fov: of the receiver, rad. sigma_ln: sigma of ln of a lamp's power.
    """

    height: float
    order: float = 0.6461 + 1.0
    half_fov: float = math.pi / 3.0
    sigma_ln: float = 0.05

    @property
    def reach(self) -> float:
        """Horizontal distance within which a lamp is received, m."""
        return RIM * self.height * math.tan(min(self.half_fov, math.radians(85.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Places that receive a lamp: indices (k,), and information terms (k, 6): w (gx^2, gx gy, gy^2, gx, gy, 1)."""

    places: npt.NDArray[np.int64]
    told: Array


def seen_from(hall: Hall, fitting: Fitting, spot: Array) -> Seen:
    """Returns the places that receive a lamp at ``spot`` (2,), m."""
    off = hall.places - spot
    near = np.flatnonzero(np.einsum("ij,ij->i", off, off) < fitting.reach**2)
    near = near[clear(hall.tall, hall.cell, spot, hall.places[near])]
    return Seen(near, told(fitting, off[near]))


def told(fitting: Fitting, off: Array) -> Array:
    """Returns the information terms of a lamp at offsets ``off`` (k, 2), m, from its nadir; see :class:`Seen`."""
    h, e = fitting.height, fitting.order + 2.0
    range2 = np.einsum("ij,ij->i", off, off)
    d2 = range2 + h * h
    diffuse = (d2 / (h * h)) ** (0.5 * e)
    variance = fitting.sigma_ln**2 + (TILT / h) ** 2 * range2 + (BY_WALLS * diffuse) ** 2
    g = -e * off / d2[:, None]
    rows = np.column_stack((g[:, 0] ** 2, g[:, 0] * g[:, 1], g[:, 1] ** 2, g[:, 0], g[:, 1], np.ones(len(g))))
    return np.asarray(rows / variance[:, None])


def information(total: Array) -> Array:
    """Returns the Fisher information (n, 3) xx, xy, yy, 1/m^2, of summed terms ``total`` (n, 6)."""
    share = 1.0 / SHARED_LN**2 + total[:, 5]
    bx, by = total[:, 3], total[:, 4]
    return np.column_stack(
        (total[:, 0] - bx * bx / share, total[:, 1] - bx * by / share, total[:, 2] - by * by / share)
    )


def worst(info: Array) -> tuple[Array, Array]:
    """Returns the largest sigma (n,), m, infinite without information, and its direction, rad."""
    xx, xy, yy = info.T
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    least = np.maximum(middle - half, 0.0)
    with np.errstate(divide="ignore"):
        sigma = 1.0 / np.sqrt(least)
    return sigma, np.asarray(0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * np.pi)
