"""What links are to the solvers of Eq. 4: strengths of known lamps, how well they can be known, and which to use.

Uncertainty is propagated from one model of what is not known (:class:`Doubt`), whichever solver is used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.light_filter.lambertian import LEAST_HEIGHT_M, pack_lamps, pack_receiver
from estimator.light_filter.survey import Lamp, Survey
from estimator.numerics.arrays import Array

Index = npt.NDArray[np.int64]

LINK_N: Final = 4
"""The paper's number of links."""
SANE: Final = (1e-6, 1e3)
"""Strengths outside these bounds, relative to that right below the lamp, are no light of this lamp."""
IN_LINE: Final = 0.02
"""Lamps whose spread across their line is less than this part of that along it stand in a line."""


class Solver(Enum):
    """How a place is found."""

    LS = "ls"
    LIN = "lin"
    ML = "ml"


@dataclass(frozen=True, slots=True)
class Doubt:
    """One sigma of what makes received strengths differ from Eq. 1, 2, beside each lamp's own ``sigma_ln``.

    Attributes:
        common_ln: of the gain all links share (receiver, dimming). tilt: rad, of lamps and receiver together.
        floor: of the diffuse share that all links have in common. floor_own: of that part of it that differs from
            link to link (light by way of near walls), as a share of the strength right below the lamp.
    """

    common_ln: float = 0.05
    tilt: float = 0.015
    floor: float = 0.008
    floor_own: float = 0.008


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """How to solve.

    Attributes:
        link_n: how many of the shortest links to use; None: all. adaptive: leave out what contradicts the other links,
            and choose the number (up to ``link_n``) by the error it is expected to leave.
        rim: links weaker than this part of a level lamp's strength at the edge of the field of view are left out:
            they came by walls alone. 0: none is left out.
        yaw: of base_link in the map, where the receiver leans; without effect for a level one.
    """

    solver: Solver = Solver.ML
    link_n: int | None = LINK_N
    adaptive: bool = False
    doubt: Doubt = field(default_factory=Doubt)
    rim: float = 0.6
    yaw: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """Links whose lamp is known: ``amplitude`` (n,) A and ``variance`` (n,) A^2, in the order of ``lamps``."""

    lamps: tuple[Lamp, ...]
    amplitude: Array
    variance: Array

    def __post_init__(self) -> None:
        if not len(self.lamps) == len(self.amplitude) == len(self.variance):
            raise ValueError(
                f"{len(self.lamps)} lamps, {len(self.amplitude)} amplitudes, {len(self.variance)} variances"
            )

    def pick(self, which: Iterable[int]) -> Received:
        """Only these links."""
        at = list(which)
        return Received(tuple(self.lamps[i] for i in at), self.amplitude[at], self.variance[at])


def strength_below(lamps: Sequence[Lamp], survey: Survey) -> Array:
    """(n,) A, amplitude right below each lamp, levelled, without floor."""
    return _below(pack_lamps(lamps, survey.depth), pack_receiver(survey.receiver))


def _below(table: Array, rx: Array) -> Array:
    h = np.maximum(table[:, 2] - rx[2], LEAST_HEIGHT_M)
    below: Array = table[:, 3] * rx[4] * (table[:, 4] + 1.0) * rx[3] / (2.0 * np.pi * h**2)
    return below


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Links ready to be solved; arrays have one element per link.

    Attributes:
        table: (n, 7) lamps and rx: (9,) receiver, as of `estimator.light_filter.lambertian`. at: index in what was
        received. xy: (n, 2) of the lamps, and h: their height above the receiver, m. amplitude: A. exponent: of
        distance in Eq. 1 for level lamp and receiver. d: distance by inversion of Eq. 1, 2, m. range2: squared
        horizontal range of Eq. 3, m^2; may be negative. rim: amplitude at the edge of the field of view, A. diffuse: of
        the amplitude, per unit of floor. variance: of ln amplitude, all but what links share.
    """

    table: Array
    rx: Array
    at: Index
    xy: Array
    h: Array
    amplitude: Array
    exponent: Array
    d: Array
    range2: Array
    rim: Array
    diffuse: Array
    variance: Array

    def pick(self, which: Sequence[int]) -> Links:
        """Only these links."""
        i = list(which)
        return Links(
            np.ascontiguousarray(self.table[i]), self.rx, self.at[i], self.xy[i], self.h[i], self.amplitude[i],
            self.exponent[i], self.d[i], self.range2[i], self.rim[i], self.diffuse[i], self.variance[i],
        )  # fmt: skip

    def residuals(self, xy: Array) -> Array:
        """(n,) of ln RSS against Eq. 1, 2 with the receiver at ``xy``."""
        d2 = np.sum((xy - self.xy) ** 2, axis=1) + self.h**2
        residuals: Array = self.exponent * np.log(np.sqrt(d2) / self.d)
        return residuals

    def covariance(self, doubt: Doubt) -> Array:
        """(n, n) of ln strength, what links share included."""
        shared = doubt.common_ln**2 + doubt.floor**2 * np.outer(self.diffuse, self.diffuse)
        total: Array = np.diag(self.variance) + shared
        return total


def usable(received: Received, survey: Survey, settings: SolverSettings) -> Links:
    """Links that can be light of their lamps and came straight (see `SolverSettings.rim`), the shortest first."""
    table, rx = pack_lamps(received.lamps, survey.depth), pack_receiver(survey.receiver)
    below = _below(table, rx)
    with np.errstate(invalid="ignore"):  # a strength that is not a number is not within bounds, and says no more
        fit = (received.amplitude > SANE[0] * below) & (received.amplitude < SANE[1] * below)
        fit &= (received.variance >= 0.0) & (received.variance < (SANE[1] * below) ** 2)
    at = np.flatnonzero(fit)
    table, below, amplitude = table[at], below[at], received.amplitude[at]
    exponent = table[:, 4] + rx[5] + 2.0
    h = np.maximum(table[:, 2] - rx[2], LEAST_HEIGHT_M)
    d = h * (below / amplitude) ** (1.0 / exponent)
    range2 = d**2 - h**2
    diffuse = below / amplitude
    own = np.array([received.lamps[i].sigma_ln for i in at])
    lean = (settings.doubt.tilt / h) ** 2 * np.maximum(range2, 0.0)
    variance = received.variance[at] / amplitude**2 + own**2 + lean + (settings.doubt.floor_own * diffuse) ** 2 + 1e-12
    rim = below * max(rx[6], 0.0) ** exponent
    links = Links(table, rx, at, table[:, :2], h, amplitude, exponent, d, range2, rim, diffuse, variance)
    order = np.argsort(d, kind="stable")
    return links.pick([int(i) for i in order if amplitude[i] >= settings.rim * rim[i]])


def shortest(received: Received, survey: Survey, rim: float = 0.0) -> tuple[int, ...]:
    """Usable links (positive, finite, not below ``rim``), the shortest first; equal lamps: the strongest first."""
    return tuple(usable(received, survey, SolverSettings(rim=rim)).at.tolist())


def without_floor(received: Received, survey: Survey) -> Received:
    """The same with the survey's diffuse floor taken off (at most 95 % of a link)."""
    floor = survey.floor * strength_below(received.lamps, survey)
    return Received(
        received.lamps, np.maximum(received.amplitude - floor, 0.05 * received.amplitude), received.variance
    )


def spread(xy: Array) -> tuple[float, float, Array]:
    """Standard deviations along and across the main axis of some places, and that axis (a unit vector)."""
    x, y = (xy - xy.mean(axis=0)).T
    xx, yy, xy_ = float(x @ x), float(y @ y), float(x @ y)
    angle = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    axis = np.array((np.cos(angle), np.sin(angle)))
    along, across = axis[0] * x + axis[1] * y, axis[0] * y - axis[1] * x
    return float(np.sqrt(np.mean(along**2))), float(np.sqrt(np.mean(across**2))), axis


def in_line(xy: Array) -> bool:
    """Whether lamps stand in a line, so that every place has a mirror image."""
    along, across, _ = spread(xy)
    return across < IN_LINE * along


def expected_error(links: Links, survey: Survey, settings: SolverSettings, xy: Array) -> Array:
    """(2, 2) expected squared error of a solver at ``xy``, m^2: its sensitivity to errors times their covariance.

    `ls` and `lin` do not know of the floor: what it does to them is a bias, and counted in. No direction is more
    uncertain than the curvature of the circles allows (lamps in a line, the place between them).
    """
    off = xy - links.xy
    d2 = np.sum(off**2, axis=1) + links.h**2
    errors = links.covariance(settings.doubt)
    if settings.solver is Solver.ML:
        J = -(links.exponent / d2)[:, None] * off
        covariance = _capped_inverse(J.T @ np.linalg.solve(errors, J))
    else:
        direct = (links.h**2 / d2) ** (0.5 * links.exponent)
        bias = np.log1p(survey.floor / direct)
        swing = 2.0 * d2 / links.exponent
        moment = np.outer(swing, swing) * (errors + np.outer(bias, bias))
        differences = settings.solver is Solver.LIN and not in_line(links.xy)
        covariance = _sandwich(2.0 * (off - off.mean(axis=0) if differences else off), moment)
    size, axes = np.linalg.eigh(covariance)
    own = 2.0 * d2 / links.exponent * np.sqrt(np.diag(errors))  # of each squared range
    combined = np.sum(own**-2.0) ** -0.5 if settings.solver is Solver.ML else np.sqrt(np.sum(own**2)) / len(own)
    capped: Array = (axes * np.clip(size, 1e-12, combined)) @ axes.T
    return capped


def _sandwich(rows: Array, moment: Array) -> Array:
    """Squared error of least squares with these rows when the right side has this second moment."""
    size, axes = np.linalg.eigh(rows.T @ rows)
    blind = size < 1e-9 * max(size[1], 1e-9)
    gain = (axes[:, ~blind] / size[~blind]) @ axes[:, ~blind].T @ rows.T
    error: Array = gain @ moment @ gain.T + 1e12 * axes[:, blind] @ axes[:, blind].T
    return error


def _capped_inverse(a: Array) -> Array:
    """Inverse of a symmetric matrix, 1e12 along directions in which it says nothing."""
    size, axes = np.linalg.eigh(a)
    inverse: Array = (axes / np.maximum(size, 1e-12)) @ axes.T
    return inverse
