"""Calibration parameter vector with priors, and the Jacobian of the RSS with respect to it.

The parameters common to all lamps come first, then those of each lamp. Each has a prior value and a prior sigma; a
sigma of zero fixes the parameter. A parameter that the drive does not determine stays at its prior.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.calibration.observations import Rows, model
from estimator.light_filter.lambertian import Wrt, pack_lamps, pack_receiver
from estimator.light_filter.survey import Lamp, Survey
from estimator.numerics.arrays import Array


class Common(IntEnum):
    """Parameters that all lamps share."""

    GAIN = 0  # ln
    FLOOR = 1
    RX_ORDER = 2
    RX_SLOPE_X = 3
    RX_SLOPE_Y = 4
    RX_X = 5  # lever arm, m
    RX_Y = 6
    FRAME_X = 7  # pose of the drive's frame in the survey's, m
    FRAME_Y = 8
    FRAME_YAW = 9
    HEIGHT = 10  # of all lamps, m
    BULGE = 11  # departure of the luminaire type from cos^m between axis and edge, ln
    OVAL_C = 12  # excess width of the luminaire type along x over y, ln
    OVAL_S = 13  # the same between the diagonals


class Own(IntEnum):
    """Parameters of each lamp."""

    GAIN = 0  # ln
    ORDER = 1
    SLOPE_X = 2
    SLOPE_Y = 3
    X = 4  # m
    Y = 5
    Z = 6
    GLOW_EAST = 7  # light reflected by a wall on that side, 1 m from the lamp, as a share of the direct light at nadir
    GLOW_WEST = 8
    GLOW_NORTH = 9
    GLOW_SOUTH = 10


COMMONS: Final = len(Common)
OWNS: Final = len(Own)
_COMMON_COLUMNS: Final = (Wrt.GAIN, Wrt.FLOOR, Wrt.RX_ORDER, Wrt.RX_SLOPE_X, Wrt.RX_SLOPE_Y, Wrt.RX_X, Wrt.RX_Y)
_OWN_COLUMNS: Final = (Wrt.GAIN, Wrt.ORDER, Wrt.LAMP_SLOPE_X, Wrt.LAMP_SLOPE_Y, Wrt.LAMP_X, Wrt.LAMP_Y, Wrt.LAMP_Z)
LEAST_ORDER: Final = 0.05
LARGEST_SLOPE: Final = 0.5
RIM_RAD: Final = 0.07
"""Closer than this to the edge of the field of view the transmission is uncertain."""
DARKEST: Final = 0.002
"""Smallest diffuse floor: no room is darker, and a filter that starts from zero could not estimate it."""
LEAST_FLOOR: Final = 0.015
"""Smallest diffuse floor that counts in the uncertainty of an observation."""
BREADTH_M: Final = 1.7
"""Sigma of the wall reflection along the wall, m."""
FADING_M: Final = 1.2
"""Length (m) over which the wall reflection falls by a factor of e."""
FARTHEST_M: Final = 3.0
"""Distance towards the wall (m) beyond which the reflection no longer grows."""
FLOOR_DOUBT: Final = 0.5
"""One sigma of the diffuse part from position to position, as a share of it."""


@dataclass(frozen=True, slots=True)
class Priors:
    """Prior sigmas; zero fixes the parameter. Tilts are in m/m, gains in ln.

    Attributes:
        gain: common to all lamps (the receiver's own, dimming). Each lamp's own is the survey's ``sigma_ln``.
        order: Lambert orders, as a share of ``0.5 + order``. slope: tilt of lamps. place: of lamps in x and y, z: in z.
        floor: the diffuse floor. rx_order, rx_slope, lever: the receiver.
        frame, frame_yaw: pose of the drive's frame in the survey's. height: common to all lamps.
        pattern: departure of the luminaire type from Lambert's law, ln. glow: wall reflection of each lamp, by side.
            Only lamp mapping frees these two, so that lamps at the edge of the trajectory are not biased. They cannot
            be stored in a survey.
    """

    gain: float = 0.5
    order: float = 0.25
    slope: float = 0.05
    place: float = 0.0
    z: float = 0.0
    floor: float = 0.01
    rx_order: float = 0.25
    rx_slope: float = 0.03
    lever: float = 0.03
    frame: float = 0.0
    frame_yaw: float = 0.0
    height: float = 0.0
    pattern: float = 0.0
    glow: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Problem:
    """Calibration problem: a survey as a parameter vector.

    Attributes:
        survey: prior survey. before, prior: (p,) values and sigmas. lamps, receiver: tables of
        `estimator.light_filter.lambertian`.
    """

    survey: Survey
    before: Array
    prior: Array
    lamps: Array = field(init=False)
    receiver: Array = field(init=False)

    def __post_init__(self) -> None:
        """Pack the tables for the kernels."""
        object.__setattr__(self, "lamps", pack_lamps(self.survey.lamps, self.survey.depth))
        object.__setattr__(self, "receiver", pack_receiver(self.survey.receiver))

    @property
    def free(self) -> npt.NDArray[np.int64]:
        """Indices of the free parameters."""
        return np.flatnonzero(self.prior > 0.0)

    def own(self, lamp: int) -> slice:
        """Slice of a lamp's parameters."""
        begin = COMMONS + OWNS * lamp
        return slice(begin, begin + OWNS)


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """Model linearised at some parameters, per row.

    Attributes:
        residual: ln(received / expected). common: (n, COMMONS), own: (n, OWNS) derivatives of ln expected.
        doubt: share of the RSS that is diffuse and uncertain. seen: whether the lamp is in plain view.
    """

    residual: Array
    common: Array
    own: Array
    doubt: Array
    seen: npt.NDArray[np.bool_]


def problem(survey: Survey, priors: Priors) -> Problem:
    """Parameter vector and priors of a survey."""
    r = survey.receiver
    common = np.array((0.0, survey.floor, r.order, r.slope_x, r.slope_y, r.x, r.y, *[0.0] * 7))
    p = priors
    rx = (p.rx_order, p.rx_slope, p.rx_slope, p.lever, p.lever)
    common_prior = np.array((p.gain, p.floor, *rx, p.frame, p.frame, p.frame_yaw, p.height, *[p.pattern] * 3))
    own = np.array([(0.0, q.order, q.slope_x, q.slope_y, q.x, q.y, q.z, *[0.0] * 4) for q in survey.lamps]).reshape(
        -1, OWNS
    )
    own_prior = np.array(
        [
            (q.sigma_ln, p.order * (0.5 + q.order), p.slope, p.slope, p.place, p.place, p.z, *[p.glow] * 4)
            for q in survey.lamps
        ]
    ).reshape(-1, OWNS)
    return Problem(survey, np.r_[common, own.ravel()], np.r_[common_prior, own_prior.ravel()])


def bounded(theta: Array) -> Array:
    """Parameters clipped to physical limits."""
    theta = theta.copy()
    own = theta[COMMONS:].reshape(-1, OWNS)
    theta[Common.FLOOR] = max(theta[Common.FLOOR], DARKEST)
    theta[Common.RX_ORDER] = max(theta[Common.RX_ORDER], LEAST_ORDER)
    own[:, Own.ORDER] = np.maximum(own[:, Own.ORDER], LEAST_ORDER)
    own[:, Own.SLOPE_X : Own.SLOPE_Y + 1] = np.clip(
        own[:, Own.SLOPE_X : Own.SLOPE_Y + 1], -LARGEST_SLOPE, LARGEST_SLOPE
    )
    return theta


def linear(task: Problem, rows: Rows, theta: Array) -> Linear:
    """Residuals and derivatives at ``theta``."""
    lamps, receiver = _tables(task, theta)
    pose = placed(theta, rows.pose)
    floor = float(theta[Common.FLOOR])
    out, J = model(lamps, receiver, pose, rows.lamp, floor)
    amplitude = np.where(out[:, 0] > 0.0, out[:, 0], np.nan)
    common = np.zeros((len(rows), COMMONS))
    common[:, : len(_COMMON_COLUMNS)] = J[:, _COMMON_COLUMNS]
    common[:, Common.FRAME_X], common[:, Common.FRAME_Y] = J[:, Wrt.X], J[:, Wrt.Y]
    dx, dy = pose[:, 0] - theta[Common.FRAME_X], pose[:, 1] - theta[Common.FRAME_Y]
    common[:, Common.FRAME_YAW] = J[:, Wrt.YAW] - dy * J[:, Wrt.X] + dx * J[:, Wrt.Y]
    common[:, Common.HEIGHT] = J[:, Wrt.LAMP_Z]
    common[:, Common.BULGE :] = _pattern(lamps[rows.lamp], pose, receiver[2])
    glow, own_glow = _glow(lamps[rows.lamp], pose, J[:, Wrt.FLOOR], theta[COMMONS:].reshape(-1, OWNS)[rows.lamp])
    doubt = FLOOR_DOUBT * max(floor, LEAST_FLOOR) * J[:, Wrt.FLOOR]
    inside = np.cos(task.survey.receiver.half_fov_rad - RIM_RAD)
    seen = (out[:, 2] > inside) & (out[:, 1] > 0.5 * amplitude)
    residual = np.log(rows.amplitude / amplitude) - common[:, Common.BULGE :] @ theta[Common.BULGE : COMMONS] - glow
    own = np.hstack((J[:, _OWN_COLUMNS], own_glow))
    return Linear(np.where(np.isfinite(residual), residual, 0.0), common, own, doubt, seen)


def _pattern(lamps: Array, pose: Array, z: float) -> Array:
    """(n, 3) derivatives of ln RSS by the departures from Lambert's law; their change with position is neglected."""
    dx, dy, h = pose[:, 0] - lamps[:, 0], pose[:, 1] - lamps[:, 1], lamps[:, 2] - z
    d2 = dx**2 + dy**2 + h**2
    return np.column_stack((4.0 * (d2 - h**2) * h**2 / d2**2, (dx**2 - dy**2) / d2, 2.0 * dx * dy / d2))


def _glow(lamps: Array, pose: Array, share: Array, own: Array) -> tuple[Array, Array]:
    """(n,) ln RSS added by wall reflections, and its derivatives (n, 4); ``share``: d ln RSS / d floor.

    Light from the lit patch of a wall beside a lamp fades about exponentially with the distance from the wall. The
    position of the wall therefore does not matter. Along the wall it follows a Gaussian.
    """
    way = pose[:, :2] - lamps[:, :2]
    sides = np.column_stack((way[:, 0], -way[:, 0], way[:, 1], -way[:, 1]))
    across = way[:, [1, 1, 0, 0]] / BREADTH_M
    each = share[:, None] * np.exp((np.minimum(sides, FARTHEST_M) - 1.0) / FADING_M - 0.5 * across**2)
    factor = np.maximum(1.0 + (each * own[:, Own.GLOW_EAST :]).sum(axis=1), 0.2)
    return np.log(factor), each / factor[:, None]


def placed(theta: Array, pose: Array) -> Array:
    """(n, 3) poses of the drive in the survey's frame."""
    x, y, yaw = theta[Common.FRAME_X], theta[Common.FRAME_Y], theta[Common.FRAME_YAW]
    c, s = np.cos(yaw), np.sin(yaw)
    there = (x + c * pose[:, 0] - s * pose[:, 1], y + s * pose[:, 0] + c * pose[:, 1], pose[:, 2] + yaw)
    return np.column_stack(there)


def _tables(task: Problem, theta: Array) -> tuple[Array, Array]:
    """Tables of lamps and receiver at ``theta``, for the kernels."""
    own = theta[COMMONS:].reshape(-1, OWNS)
    lamps = task.lamps.copy()
    lamps[:, 0:2], lamps[:, 2] = own[:, Own.X : Own.Y + 1], own[:, Own.Z] + theta[Common.HEIGHT]
    lamps[:, 3] = task.lamps[:, 3] * np.exp(theta[Common.GAIN] + own[:, Own.GAIN])
    lamps[:, 4:7] = own[:, Own.ORDER : Own.SLOPE_Y + 1]
    receiver = task.receiver.copy()
    receiver[0], receiver[1] = theta[Common.RX_X], theta[Common.RX_Y]
    receiver[5] = theta[Common.RX_ORDER]
    receiver[7], receiver[8] = theta[Common.RX_SLOPE_X], theta[Common.RX_SLOPE_Y]
    return lamps, receiver


def survey_at(task: Problem, theta: Array, sigma_ln: Array) -> Survey:
    """Survey with these parameters; ``sigma_ln`` (K,): one sigma of ln power of the lamps."""
    own = theta[COMMONS:].reshape(-1, OWNS)
    lamps = tuple(_lamp(lamp, theta, row, s) for lamp, row, s in zip(task.survey.lamps, own, sigma_ln, strict=True))
    receiver = replace(
        task.survey.receiver,
        x=float(theta[Common.RX_X]),
        y=float(theta[Common.RX_Y]),
        order=float(theta[Common.RX_ORDER]),
        slope_x=float(theta[Common.RX_SLOPE_X]),
        slope_y=float(theta[Common.RX_SLOPE_Y]),
    )
    return replace(task.survey, lamps=lamps, receiver=receiver, floor=float(theta[Common.FLOOR]))


def _lamp(lamp: Lamp, theta: Array, own: Array, sigma_ln: float) -> Lamp:
    """One lamp with its parameters."""
    return replace(
        lamp,
        x=float(own[Own.X]),
        y=float(own[Own.Y]),
        z=float(own[Own.Z] + theta[Common.HEIGHT]),
        power_w=lamp.power_w * float(np.exp(theta[Common.GAIN] + own[Own.GAIN])),
        order=float(own[Own.ORDER]),
        slope_x=float(own[Own.SLOPE_X]),
        slope_y=float(own[Own.SLOPE_Y]),
        sigma_ln=float(sigma_ln),
    )
