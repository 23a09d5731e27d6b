"""What a place learns of its position from each lamp it sees: Eq. 1 and its derivative, with what is not known of it.

ln of a received strength has, for level lamp and receiver, the gradient -(m_t + m_r + 2) (p - l) / d^2 (Eq. 7), and the
variance of `estimator.paper.lateration_model.usable`: the lamp's own power, the lean of ceiling and robot, light by way
of walls. What all links share, the receiver's gain, is taken out by the Sherman-Morrison formula, so that what lamps
tell a place adds up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.commissioning.floor import Array, Hall, clear

SHARED_LN, TILT, BY_WALLS = 0.05, 0.015, 0.008
"""As in `lateration_model.Doubt`: gain that all links share, lean (rad), diffuse part of its own."""
RIM: Final = 0.97
"""Part of the cone's radius in which a lamp counts: at its edge a robot that leans loses it."""


@dataclass(frozen=True, slots=True)
class Fitting:
    """What kind of lamp and receiver.

    Attributes:
        height: of lamps above the receiver, m. order: Lambert order of the lamps plus that of the receiver.
        half_fov: of the receiver, rad. sigma_ln: of a lamp's power, one sigma.
    """

    height: float
    order: float = 0.6461 + 1.0
    half_fov: float = math.pi / 3.0
    sigma_ln: float = 0.05

    @property
    def reach(self) -> float:
        """Horizontal metres within which a lamp is received."""
        return RIM * self.height * math.tan(min(self.half_fov, math.radians(85.0)))


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """The places that see a lamp: their indices (k,), and what each learns (k, 6): w (gx^2, gx gy, gy^2, gx, gy, 1)."""

    places: npt.NDArray[np.int64]
    told: Array


def seen_from(hall: Hall, fitting: Fitting, spot: Array) -> Seen:
    """The places that see a lamp at ``spot`` (2,)."""
    off = hall.places - spot
    near = np.flatnonzero(np.einsum("ij,ij->i", off, off) < fitting.reach**2)
    near = near[clear(hall.tall, hall.cell, spot, hall.places[near])]
    return Seen(near, told(fitting, off[near]))


def told(fitting: Fitting, off: Array) -> Array:
    """What places at ``off`` (k, 2) from right below a lamp learn of it; see :class:`Seen`."""
    h, e = fitting.height, fitting.order + 2.0
    range2 = np.einsum("ij,ij->i", off, off)
    d2 = range2 + h * h
    diffuse = (d2 / (h * h)) ** (0.5 * e)
    variance = fitting.sigma_ln**2 + (TILT / h) ** 2 * range2 + (BY_WALLS * diffuse) ** 2
    g = -e * off / d2[:, None]
    rows = np.column_stack((g[:, 0] ** 2, g[:, 0] * g[:, 1], g[:, 1] ** 2, g[:, 0], g[:, 1], np.ones(len(g))))
    return np.asarray(rows / variance[:, None])


def information(total: Array) -> Array:
    """(n, 3) Fisher information xx, xy, yy of places whose lamps told ``total`` (n, 6)."""
    share = 1.0 / SHARED_LN**2 + total[:, 5]
    bx, by = total[:, 3], total[:, 4]
    return np.column_stack(
        (total[:, 0] - bx * bx / share, total[:, 1] - bx * by / share, total[:, 2] - by * by / share)
    )


def worst(info: Array) -> tuple[Array, Array]:
    """Largest deviation (n,) m of places with this information, infinite where it is none, and its direction, rad."""
    xx, xy, yy = info.T
    middle, half = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    least = np.maximum(middle - half, 0.0)
    with np.errstate(divide="ignore"):
        sigma = 1.0 / np.sqrt(least)
    return sigma, np.asarray(0.5 * np.arctan2(2.0 * xy, xx - yy) + 0.5 * np.pi)
