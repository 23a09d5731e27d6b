"""How ceiling lamps radiate and how a photodiode accepts light: tables, as a goniometer would measure them.

Neither is a power of a cosine. A lamp of the paper has a half-power angle of 70 degrees; its table has that, but bulges
between axis and rim as panels with prismatic covers do, is wider along one axis than across, and is cut off by its
frame. Every single lamp departs from its type a little more. The photodiode looks through a window (Fresnel losses) out
of a housing, which ends its field of view softly and not quite round.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ANGLES: Final = np.radians(np.arange(0.0, 90.1, 2.5))
AZIMUTHS: Final = np.radians(np.arange(0.0, 360.0, 15.0))
FINE: Final = np.radians(np.arange(0.0, 90.1, 0.5))
RIM: Final = np.radians(1.5)
"""Half the width over which the housing ends the field of view."""


def lambert_order(half_angle_deg: float) -> float:
    """Exponent m of cos^m with that half-power angle."""
    return float(-np.log(2.0) / np.log(np.cos(np.radians(half_angle_deg))))


def emission(half_angle_deg: float, odd: float, own: Array) -> Array:
    """(angles, azimuths) intensity in W/sr of a lamp that radiates 1 W.

    Args:
        half_angle_deg: at which the type has half of its power on the axis.
        odd: how far the table departs from cos^m; 1 as measured, 0 none.
        own: (4,) standard normal numbers that make this lamp differ from its type.
    """
    half = np.radians(half_angle_deg)
    gamma, azimuth = ANGLES[:, None], AZIMUTHS[None, :]
    type_ = _axial(gamma[:, 0], half, odd) / _axial(np.array([half]), half, odd) * 0.5
    type_ = type_ / type_[0]
    power = np.log(0.5) / np.log(np.interp(half, gamma[:, 0], type_))
    table = type_[:, None] ** power * np.ones_like(azimuth)
    oval = 0.05 * np.cos(2.0 * azimuth) + 0.012 * own[0] * np.cos(azimuth - own[1])
    ripple = 0.008 * own[2] * np.sin(3.0 * gamma) + 0.006 * own[3] * np.sin(6.0 * gamma + own[1])
    table *= 1.0 + odd * (np.sin(gamma) ** 2 * oval + ripple)
    table[-1] = 0.0
    return np.ascontiguousarray(table / _flux(table))


def _axial(gamma: Array, half: float, odd: float) -> Array:
    """Lambert's law, a bulge half way to the rim, and a frame that begins to cut at 75 degrees."""
    order = -np.log(2.0) / np.log(np.cos(half))
    law = np.cos(gamma) ** order
    bulge = 1.0 + 0.06 * odd * np.sin(np.clip(gamma / half, 0.0, 1.0) * np.pi) ** 2
    cut = 1.0 - 0.5 * odd * np.clip((gamma - np.radians(75.0)) / np.radians(15.0), 0.0, 1.0) ** 2
    return np.asarray(law * bulge * cut)


def _flux(table: Array) -> float:
    """Power radiated into the lower half space."""
    ring = table.mean(axis=1) * np.sin(ANGLES) * 2.0 * np.pi
    return float(np.sum(0.5 * (ring[1:] + ring[:-1]) * np.diff(ANGLES)))


def acceptance(half_fov_deg: float, odd: float) -> Array:
    """(angles, azimuths) response to light from a direction, cosine included; 1 on the axis."""
    beta, azimuth = FINE[:, None], AZIMUTHS[None, :]
    window = 1.0 - 0.9 * odd * (1.0 - np.cos(beta)) ** 5 - 0.03 * odd * np.sin(beta) ** 4
    housing = 0.015 * odd * np.sin(beta) ** 2 * np.cos(azimuth - 0.7)
    rim = np.radians(half_fov_deg) + 0.5 * odd * RIM * np.cos(azimuth + 1.1)
    width = max(odd, 1e-3) * RIM
    edge = np.clip(0.5 - (beta - rim) / (2.0 * width), 0.0, 1.0)
    return np.ascontiguousarray(np.cos(beta) * window * (1.0 + housing) * edge)
