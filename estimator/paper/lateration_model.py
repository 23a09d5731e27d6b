"""Link model of the lateration solvers (Eq. 4): RSS of known lamps, their noise, and the usable links.

One noise model (:class:`Doubt`) gives the covariance for every solver.
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
"""Limits of a plausible RSS, relative to that directly below the lamp."""
IN_LINE: Final = 0.02
"""Largest ratio of the spread across to the spread along the line of collinear lamps."""


class Solver(Enum):
    """Method to solve for the position."""

    LS = "ls"
    LIN = "lin"
    ML = "ml"


@dataclass(frozen=True, slots=True)
class Doubt:
    """One sigma of the differences between RSS and Eq. 1, 2, beside each lamp's own ``sigma_ln``.

    Attributes:
        common_ln: of the gain that all links share (receiver, dimming).
        tilt: rad, of lamps and receiver together.
        floor: of the diffuse share that all links have in common.
        floor_own: of its part that differs between links (light from near walls), as a share of the RSS below the lamp.
    """

    common_ln: float = 0.05
    tilt: float = 0.015
    floor: float = 0.008
    floor_own: float = 0.008


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """Settings of the solver.

    Attributes:
        solver: see :class:`Solver`.
        link_n: number of the shortest links in use; None: all.
        adaptive: exclude links inconsistent with the others, and choose the number (up to ``link_n``) by the expected
            error.
        doubt: noise model.
        rim: links below this share of a level lamp's RSS at the edge of the field of view are excluded: their light
            came from walls alone. 0: none is excluded.
        yaw: of base_link in the map, for a tilted receiver; without effect for a level one.
    """

    solver: Solver = Solver.ML
    link_n: int | None = LINK_N
    adaptive: bool = False
    doubt: Doubt = field(default_factory=Doubt)
    rim: float = 0.6
    yaw: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """Links of known lamps: ``amplitude`` (n,) A and ``variance`` (n,) A^2, in the order of ``lamps``."""

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
    """(n,) A, RSS directly below each lamp, levelled, without diffuse floor."""
    return _below(pack_lamps(lamps, survey.depth), pack_receiver(survey.receiver))


def _below(table: Array, rx: Array) -> Array:
    h = np.maximum(table[:, 2] - rx[2], LEAST_HEIGHT_M)
    below: Array = table[:, 3] * rx[4] * (table[:, 4] + 1.0) * rx[3] / (2.0 * np.pi * h**2)
    return below


@dataclass(frozen=True, slots=True, eq=False)
class Links:
    """Links ready to be solved; arrays have one element per link.

    Attributes:
        table: (n, 7) lamps, and rx: (9,) receiver, as of `estimator.light_filter.lambertian`.
        at: index among the received links.
        xy: (n, 2) of the lamps, m.
        h: their height above the receiver, m.
        amplitude: RSS, A.
        exponent: of the distance in Eq. 1 for level lamp and receiver.
        d: distance by inversion of Eq. 1, 2, m.
        range2: squared horizontal range of Eq. 3, m^2; may be negative.
        rim: RSS at the edge of the field of view, A.
        diffuse: share of the RSS per unit of diffuse floor.
        variance: of ln RSS, without the part that links share.
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
        """(n, n) of ln RSS, with the part that links share."""
        shared = doubt.common_ln**2 + doubt.floor**2 * np.outer(self.diffuse, self.diffuse)
        total: Array = np.diag(self.variance) + shared
        return total


def usable(received: Received, survey: Survey, settings: SolverSettings) -> Links:
    """Links with a plausible RSS in line of sight (see `Method.rim`), the shortest first."""
    table, rx = pack_lamps(received.lamps, survey.depth), pack_receiver(survey.receiver)
    below = _below(table, rx)
    with np.errstate(invalid="ignore"):  # NaN fails both comparisons
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
    """Usable links (positive, finite, not below ``rim``), the shortest first; for equal lamps the strongest first."""
    return tuple(usable(received, survey, SolverSettings(rim=rim)).at.tolist())


def without_floor(received: Received, survey: Survey) -> Received:
    """The same links without the survey's diffuse floor (at most 95 % of a link)."""
    floor = survey.floor * strength_below(received.lamps, survey)
    return Received(
        received.lamps, np.maximum(received.amplitude - floor, 0.05 * received.amplitude), received.variance
    )


def spread(xy: Array) -> tuple[float, float, Array]:
    """Standard deviations along and across the main axis of some positions, and that axis (a unit vector)."""
    x, y = (xy - xy.mean(axis=0)).T
    xx, yy, xy_ = float(x @ x), float(y @ y), float(x @ y)
    angle = 0.5 * np.arctan2(2.0 * xy_, xx - yy)
    axis = np.array((np.cos(angle), np.sin(angle)))
    along, across = axis[0] * x + axis[1] * y, axis[0] * y - axis[1] * x
    return float(np.sqrt(np.mean(along**2))), float(np.sqrt(np.mean(across**2))), axis


def in_line(xy: Array) -> bool:
    """Whether lamps are collinear, so that every position has a mirror image."""
    along, across, _ = spread(xy)
    return across < IN_LINE * along


def expected_error(links: Links, survey: Survey, settings: SolverSettings, xy: Array) -> Array:
    """(2, 2) expected squared error of a solver at ``xy``, m^2: its sensitivity to errors times their covariance.

    `ls` and `lin` ignore the diffuse floor; its effect on them is included as a bias. The curvature of the circles
    limits the error in every direction (collinear lamps, the position between them).
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
    own = 2.0 * d2 / links.exponent * np.sqrt(np.diag(errors))  # sigma of each squared range
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
    """Inverse of a symmetric matrix, 1e12 along directions without information."""
    size, axes = np.linalg.eigh(a)
    inverse: Array = (axes / np.maximum(size, 1e-12)) @ axes.T
    return inverse
