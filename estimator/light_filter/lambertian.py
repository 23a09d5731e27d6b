"""Lambertian lamp model (Eq. 1, 2 and 7): expected photocurrent of a ceiling lamp, with its Jacobian.

Eq. 1    H = (m_t + 1) A / (2 pi d^2) * cos(alpha)^m_t * cos(beta)^m_r     for beta <= half field of view, else 0
Eq. 2    a = responsivity * depth * P_t * exp(gain) * (H + floor * N),     N = (m_t + 1) A / (2 pi h^2)

alpha is the angle to the lamp's axis, beta to the receiver's. h is the lamp's height above the receiver, so N is H
directly below a level lamp. ``floor`` is the diffuse floor (light that came by ceiling, walls and furniture), the same
share for all lamps. Filter and concentrator (T_s, G) are part of the area A. Eq. 7 is the Jacobian of a.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final

import numpy as np

from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel


class Wrt(IntEnum):
    """Columns of a Jacobian: the variables of the derivatives."""

    X = 0  # base in the map, m
    Y = 1
    YAW = 2
    GAIN = 3  # ln of the lamp's power
    FLOOR = 4  # diffuse floor
    ORDER = 5  # m_t
    LAMP_SLOPE_X = 6
    LAMP_SLOPE_Y = 7
    LAMP_Z = 8
    RX_ORDER = 9  # m_r
    RX_SLOPE_X = 10
    RX_SLOPE_Y = 11
    RX_X = 12  # lever arm in base_link
    RX_Y = 13
    RX_Z = 14
    LAMP_X = 15
    LAMP_Y = 16


COLUMNS: Final = len(Wrt)
LAMP_COLUMNS: Final = 7
RECEIVER_COLUMNS: Final = 9
LEAST_HEIGHT_M: Final = 0.05
"""Minimum height of a lamp above the receiver in the model; a lower one is an error of the survey, not of the light."""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """Expected RSS. Arrays have one row per lamp.

    Attributes:
        amplitude: (n,) RSS, A, of the modulated photocurrent. direct: (n,) its line-of-sight part, A.
        jacobian: (n, 17) of ln RSS, columns of :class:`Wrt`; zero where nothing is received.
        beta_rad: (n,) angle to the receiver's axis.
    """

    amplitude: Array
    direct: Array
    jacobian: Array
    beta_rad: Array


def pack_lamps(lamps: Sequence[Lamp], depth: float) -> Array:
    """Lamps as rows ``x, y, z, modulated power, order, slope_x, slope_y`` for the kernels, shape (n, 7)."""
    rows = [(p.x, p.y, p.z, depth * p.power_w, p.order, p.slope_x, p.slope_y) for p in lamps]
    return np.array(rows, dtype=np.float64).reshape(len(rows), LAMP_COLUMNS)


def pack_receiver(receiver: Receiver) -> Array:
    """Receiver as ``x, y, z, area, responsivity, order, cos(half fov), slope_x, slope_y`` (9,) for the kernels."""
    r = receiver
    cos_fov = float(np.cos(r.half_fov_rad))
    return np.array((r.x, r.y, r.z, r.area_m2, r.responsivity, r.order, cos_fov, r.slope_x, r.slope_y))


@kernel("f8(f8[::1], f8[::1], f8[::1], f8, f8[::1], f8[::1])", inner=True)
def expect(lamp: Array, rx: Array, pose: Array, floor: float, out: Array, J: Array) -> float:
    """RSS of one lamp (at gain 0) and its derivatives.

    Args:
        lamp: (7,) of `pack_lamps`.
        rx: (9,) of `pack_receiver`.
        pose: (x, y, yaw) of the base in the map.
        floor: the diffuse floor.
        out: (3,) out: RSS (A), its direct part (A) and cos(beta).
        J: (17,) out: derivatives of the RSS (not of its logarithm).

    Returns:
        The RSS, A.
    """
    c, s = np.cos(pose[2]), np.sin(pose[2])
    arm_x, arm_y = c * rx[0] - s * rx[1], s * rx[0] + c * rx[1]
    ax, ay = c * rx[7] - s * rx[8], s * rx[7] + c * rx[8]
    vx, vy = lamp[0] - pose[0] - arm_x, lamp[1] - pose[1] - arm_y
    vz = max(lamp[2] - rx[2], LEAST_HEIGHT_M)
    m, mr = lamp[4], rx[5]
    d2 = vx * vx + vy * vy + vz * vz
    norm_t2 = 1.0 + lamp[5] * lamp[5] + lamp[6] * lamp[6]
    norm_r2 = 1.0 + rx[7] * rx[7] + rx[8] * rx[8]
    q = vz - vx * lamp[5] - vy * lamp[6]
    w = vz + vx * ax + vy * ay
    cos_a, cos_b = q / np.sqrt(d2 * norm_t2), w / np.sqrt(d2 * norm_r2)
    k = lamp[3] * rx[4] * (m + 1.0) * rx[3] / (2.0 * np.pi)
    diffuse = k / (vz * vz)
    J[:] = 0.0
    direct = 0.0
    if cos_a > 0.0 and cos_b > 0.0 and cos_b >= rx[6]:
        direct = k / d2 * cos_a**m * cos_b**mr
        e = 2.0 + m + mr
        gx = -m * lamp[5] / q + mr * ax / w - e * vx / d2
        gy = -m * lamp[6] / q + mr * ay / w - e * vy / d2
        gz = m / q + mr / w - e * vz / d2
        J[0], J[1], J[15], J[16] = -direct * gx, -direct * gy, direct * gx, direct * gy
        J[2] = direct * (arm_y * gx - arm_x * gy + mr / w * (vy * ax - vx * ay))
        J[5] = direct * np.log(cos_a)
        J[6] = direct * m * (-vx / q - lamp[5] / norm_t2)
        J[7] = direct * m * (-vy / q - lamp[6] / norm_t2)
        J[8] = direct * gz
        J[9] = direct * np.log(cos_b)
        J[10] = direct * mr * ((vx * c + vy * s) / w - rx[7] / norm_r2)
        J[11] = direct * mr * ((vy * c - vx * s) / w - rx[8] / norm_r2)
        J[12], J[13] = -direct * (c * gx + s * gy), direct * (s * gx - c * gy)
    amplitude = direct + floor * diffuse
    J[3], J[4] = amplitude, diffuse
    J[5] += amplitude / (m + 1.0)
    J[8] -= 2.0 * floor * diffuse / vz
    J[14] = -J[8]
    out[0], out[1], out[2] = amplitude, direct, cos_b
    return float(amplitude)


@kernel("void(f8[:, ::1], f8[::1], f8[::1], f8, f8[:, ::1], f8[:, ::1])")
def expect_all(lamps: Array, rx: Array, pose: Array, floor: float, out: Array, J: Array) -> None:
    """:func:`expect` for every lamp; fills ``out`` (n, 3) and ``J`` (n, 17)."""
    for i in range(lamps.shape[0]):
        expect(lamps[i], rx, pose, floor, out[i], J[i])


def expected(lamps: Sequence[Lamp], survey: Survey, T_map_base: Array, floor: float | None = None) -> Expected:
    """Expected RSS of these lamps from a pose, with the survey's receiver and depth.

    Args:
        lamps: any, surveyed or self-described.
        survey: for receiver and depth.
        T_map_base: (x, y, yaw).
        floor: the diffuse floor; the survey's where None.
    """
    table, rx = pack_lamps(lamps, survey.depth), pack_receiver(survey.receiver)
    n = len(table)
    out, J = np.zeros((n, 3)), np.zeros((n, COLUMNS))
    pose = np.ascontiguousarray(T_map_base, dtype=np.float64)
    expect_all(table, rx, pose, survey.floor if floor is None else floor, out, J)
    amplitude, direct, cos_b = (np.ascontiguousarray(column) for column in out.T)
    some = amplitude > 0.0
    J[some] /= amplitude[some, None]
    J[~some] = 0.0
    return Expected(amplitude, direct, J, np.arccos(np.clip(cos_b, -1.0, 1.0)))
