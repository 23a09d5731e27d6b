"""How well the place along a row of lamps can be known at all: the Cramer-Rao bound of a filter (Tichavsky, 1998).

Everything is given but the place along the corridor and what is drawn by chance beside it: each lamp's gain, lean and
place off the survey, the wheels' scale and noise, the noise of the receiver. Distance from the walls, heading, walls'
reflections and the luminaires' true characteristics are taken to be known, which they are to no robot. For a linear
model with Gaussian errors the covariance of the Kalman filter that knows the truth is the bound, and over the
centimetres in question this one is linear.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.light_filter.lambertian import Wrt, expected
from estimator.light_filter.survey import Survey
from estimator.measurements import LightEpoch
from tools.sim.building.world import Array

RIM_RAD: Final = np.radians(8.0)
"""Links so near to the edge of the receiver's view are not used."""


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """One epoch from where the robot truly was.

    Attributes:
        along: place along the corridor, m. lamps: numbers of those whose light came straight. variance: of the noise of
            ln amplitude. by_place: d ln amplitude / d along, 1/m. by_lean: the same by the lamp's lean along it.
    """

    along: float
    lamps: tuple[int, ...]
    variance: Array
    by_place: Array
    by_lean: Array


@dataclass(frozen=True, slots=True)
class Sizes:
    """One sigma of what is not known: ln gain; lean, rad; a lamp's place, m; wheels' scale; noise, m by root m."""

    gain: float
    lean: float
    place: float
    scale: float
    wheels: float


def seen(epoch: LightEpoch, pose: Array, survey: Survey, axis: int) -> Seen:
    """What an epoch tells at the truth; ``axis`` 0: the corridor runs along x, 1: along y."""
    by_code = {lamp.code: lamp for lamp in survey.lamps}
    where = [k for k, code in enumerate(epoch.ids.tolist()) if code in by_code]
    lamps = [by_code[int(epoch.ids[k])] for k in where]
    said = expected(lamps, survey, pose)
    used = np.flatnonzero(said.beta_rad < survey.receiver.half_fov_rad - RIM_RAD)
    at, J = [where[k] for k in used], said.jacobian[used]
    return Seen(
        float(pose[axis]),
        tuple(lamps[k].lamp_id for k in used),
        epoch.variance[at] / epoch.amplitude[at] ** 2,
        J[:, Wrt.X + axis],
        J[:, Wrt.LAMP_SLOPE_X + axis],
    )


def bound(epochs: Sequence[Seen], sizes: Sizes, start_m: float = 0.5) -> Array:
    """(n,) sigma (m) of the place along the corridor after each epoch, at best."""
    ids = sorted({lamp for one in epochs for lamp in one.lamps})
    column, n = {lamp: 2 + 3 * k for k, lamp in enumerate(ids)}, 2 + 3 * len(ids)
    own = (sizes.gain**2, sizes.lean**2, sizes.place**2)
    P = np.diag([start_m**2, sizes.scale**2, *np.tile(own, len(ids))])
    out, before = [], epochs[0].along
    for one in epochs:
        way, before = one.along - before, one.along
        F = np.eye(n)
        F[0, 1] = way
        P = F @ P @ F.T
        P[0, 0] += sizes.wheels**2 * abs(way)
        for lamp, variance, slope, lean in zip(one.lamps, one.variance, one.by_place, one.by_lean, strict=True):
            h, at = np.zeros(n), column[lamp]
            h[0], h[at], h[at + 1], h[at + 2] = slope, 1.0, lean, -slope
            gain = P @ h / (h @ P @ h + variance)
            P -= np.outer(gain, h @ P)
        P = 0.5 * (P + P.T)
        out.append(float(np.sqrt(P[0, 0])))
    return np.array(out)
