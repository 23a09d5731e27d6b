"""What calibration may change, how surely it was known before, and how the received strengths depend on it.

The parameters stand in one vector: those common to all lamps first, then each lamp's. Each has a value before and a
prior sigma; a sigma of zero takes it as given. What a drive does not tell stays where its prior holds it.
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
    FRAME_X = 7  # where the drive's frame lies in the survey's, m
    FRAME_Y = 8
    FRAME_YAW = 9
    HEIGHT = 10  # of all lamps, m
    BULGE = 11  # departure of the lamps' type from cos^m between axis and rim, ln
    OVAL_C = 12  # by which the type is wider along x than along y, ln
    OVAL_S = 13  # the same along the diagonals


class Own(IntEnum):
    """Parameters of each lamp."""

    GAIN = 0  # ln
    ORDER = 1
    SLOPE_X = 2
    SLOPE_Y = 3
    X = 4  # m
    Y = 5
    Z = 6
    GLOW_EAST = 7  # light by way of a wall on that side, 1 m from the lamp, as a share of the direct light at its nadir
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
"""Nearer than this to the edge of the field of view nobody knows how much comes through."""
DARKEST: Final = 0.002
"""Of the diffuse share: no room is darker, and a filter that starts from nothing could not tell it."""
LEAST_FLOOR: Final = 0.015
BREADTH_M: Final = 1.7
FADING_M: Final = 1.2
FARTHEST_M: Final = 3.0
FLOOR_DOUBT: Final = 0.5
"""By how much of itself the diffuse part may differ from place to place."""


@dataclass(frozen=True, slots=True)
class Priors:
    """One sigma before the drive; zero: taken as given. Slopes are metres per metre, gains ln.

    Attributes:
        gain: common to all lamps (the receiver's own, dimming). Each lamp's own is the survey's ``sigma_ln``.
        order: Lambert orders, as a part of ``0.5 + order``. slope: of lamps. place: of lamps in x and y, z: in z.
        floor: the diffuse share. rx_order, rx_slope, lever: the receiver.
        frame, frame_yaw: where the drive's frame lies in the survey's. height: common to all lamps.
        pattern: departure of the lamps' type from Lambert's law, ln. glow: of each lamp by way of walls, by side.
            Only a survey by drive looks for these two, so that lamps at the edge of the way are not drawn aside; they
            cannot be kept in a survey.
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
    """A survey as a vector of parameters.

    Attributes:
        survey: as it was. before, prior: (p,) values and sigmas. lamps, receiver: tables of
        `estimator.light_filter.lambertian`.
    """

    survey: Survey
    before: Array
    prior: Array
    lamps: Array = field(init=False)
    receiver: Array = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "lamps", pack_lamps(self.survey.lamps, self.survey.depth))
        object.__setattr__(self, "receiver", pack_receiver(self.survey.receiver))

    @property
    def free(self) -> npt.NDArray[np.int64]:
        """Numbers of the parameters that may change."""
        return np.flatnonzero(self.prior > 0.0)

    def own(self, lamp: int) -> slice:
        """Where a lamp's parameters stand."""
        begin = COMMONS + OWNS * lamp
        return slice(begin, begin + OWNS)


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """The model at some parameters, per row.

    Attributes:
        residual: ln received over expected. common: (n, COMMONS), own: (n, OWNS) derivatives of ln expected.
        doubt: the part of the amplitude that is diffuse and uncertain. seen: whether the row is in plain view.
    """

    residual: Array
    common: Array
    own: Array
    doubt: Array
    seen: npt.NDArray[np.bool_]


def problem(survey: Survey, priors: Priors) -> Problem:
    """A survey with what is known of it before the drive."""
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
    """Parameters pulled back to what can be."""
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
    """(n, 3) how the departures from Lambert's law act at each row; how they change with place is left out."""
    dx, dy, h = pose[:, 0] - lamps[:, 0], pose[:, 1] - lamps[:, 1], lamps[:, 2] - z
    d2 = dx**2 + dy**2 + h**2
    return np.column_stack((4.0 * (d2 - h**2) * h**2 / d2**2, (dx**2 - dy**2) / d2, 2.0 * dx * dy / d2))


def _glow(lamps: Array, pose: Array, share: Array, own: Array) -> tuple[Array, Array]:
    """(n,) ln that light by way of walls adds, and its derivatives (n, 4); ``share``: d ln amplitude / d floor.

    Light from the lit patch of a wall beside a lamp fades about exponentially with the distance from the wall, so that
    where the wall stands does not matter, and like a bell along it.
    """
    way = pose[:, :2] - lamps[:, :2]
    sides = np.column_stack((way[:, 0], -way[:, 0], way[:, 1], -way[:, 1]))
    across = way[:, [1, 1, 0, 0]] / BREADTH_M
    each = share[:, None] * np.exp((np.minimum(sides, FARTHEST_M) - 1.0) / FADING_M - 0.5 * across**2)
    factor = np.maximum(1.0 + (each * own[:, Own.GLOW_EAST :]).sum(axis=1), 0.2)
    return np.log(factor), each / factor[:, None]


def placed(theta: Array, pose: Array) -> Array:
    """Poses of the drive in the survey's frame."""
    x, y, yaw = theta[Common.FRAME_X], theta[Common.FRAME_Y], theta[Common.FRAME_YAW]
    c, s = np.cos(yaw), np.sin(yaw)
    there = (x + c * pose[:, 0] - s * pose[:, 1], y + s * pose[:, 0] + c * pose[:, 1], pose[:, 2] + yaw)
    return np.column_stack(there)


def _tables(task: Problem, theta: Array) -> tuple[Array, Array]:
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
    """The survey with these parameters; ``sigma_ln`` (K,) of the lamps' powers."""
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
