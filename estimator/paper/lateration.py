"""Lateration (Eq. 3, 4): receiver position from the RSS of a few lamps, with shortest-link selection and covariance.

Eq. 3    (x_i - x)^2 + (y_i - y)^2 = d_i^2 - h_i^2,    d_i by inversion of Eq. 1, 2 for level lamps and receiver
Eq. 4    position = argmin sum over the Link_n shortest links of [(x_i - x)^2 + (y_i - y)^2 - (d_i^2 - h_i^2)]^2

There are three solvers. `ls` is Eq. 4 as printed. `lin` takes differences of Eq. 3, which are linear. `ml` fits ln RSS,
each weighted by its variance, with the common gain and the diffuse floor as additional unknowns. Positions are those of
the receiver (the photodiode), in the survey frame, m.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.numerics.arrays import Array
from estimator.paper.adaptive_link_selection import adapted
from estimator.paper.lateration_model import (
    LINK_N,
    Doubt,
    Links,
    Received,
    Solver,
    SolverSettings,
    expected_error,
    shortest,
    spread,
    usable,
    without_floor,
)
from estimator.paper.lateration_solvers import DECIDED, SAME_M, Strengths, solve


class Why(Enum):
    """Kind of a lateration result."""

    PLACE = "one place fits"
    MIRROR = "two places fit, the lamps alone do not tell which"
    PRIOR = "two places fit, the prior knowledge tells which"
    CIRCLE = "one lamp: every place on a circle around it fits"
    NONE = "no usable link"
    NO_FIT = "no descent settled"


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """Prior position of the receiver: ``xy`` (2,) and ``covariance`` (2, 2)."""

    xy: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """One position that fits.

    Attributes:
        xy: (2,) m.
        covariance: (2, 2) m^2, expected squared error under the :class:`Doubt`.
        chi2, freedom: of the residuals of ln RSS under the same; freedom 0 without redundant links.
        gain, floor: common ln gain and diffuse share; the survey's with `ls` and `lin`, which do not estimate them.
    """

    xy: Array
    covariance: Array
    chi2: float
    freedom: int
    gain: float
    floor: float


@dataclass(frozen=True, slots=True)
class Circle:
    """Circle of positions around a single lamp; ``sigma`` of the radius, m."""

    x: float
    y: float
    radius: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Lateration result: positions (best first; more than one only with `Why.MIRROR`), used links, shortest first."""

    why: Why
    places: tuple[Place, ...] = ()
    circle: Circle | None = None
    used: tuple[int, ...] = ()


def locate(
    received: Received, survey: Survey, settings: SolverSettings | None = None, prior: Prior | None = None
) -> Located:
    """Receiver position from these RSS; bad geometry raises nothing, and the result contains the ambiguity.

    With two links, or collinear lamps, two mirrored positions fit: ``prior`` selects one, where it can.
    """
    settings = SolverSettings() if settings is None else settings
    links = usable(received, survey, settings)
    if settings.adaptive:
        links = links.pick(adapted(links, survey, settings))
    elif settings.link_n is not None and len(links.d) > settings.link_n:
        links = links.pick(range(settings.link_n))
    used = tuple(links.at.tolist())
    if not used:
        return Located(Why.NONE)
    if len(used) == 1 or spread(links.xy)[0] < SAME_M:
        return Located(Why.CIRCLE, (), _circle(links, settings.doubt), used)
    places = [_place(links, survey, settings, theta) for theta in solve(links, survey, settings)]
    return _decide(places, used, prior)


def _decide(places: list[Place], used: tuple[int, ...], prior: Prior | None) -> Located:
    """One position, or several that only the prior can separate."""
    if not places:
        return Located(Why.NO_FIT, used=used)
    if len(places) == 1:
        return Located(Why.PLACE, tuple(places), used=used)
    if prior is None:
        return Located(Why.MIRROR, tuple(places), used=used)
    scores = []
    for place in places:
        off = place.xy - prior.xy
        scores.append(place.chi2 + float(off @ np.linalg.solve(place.covariance + prior.covariance, off)))
    order = np.argsort(scores, kind="stable")
    best = tuple(places[i] for i in order if scores[i] - min(scores) < DECIDED)
    return Located(Why.PRIOR if len(best) == 1 else Why.MIRROR, best, used=used)


def _circle(links: Links, doubt: Doubt) -> Circle:
    radius = float(np.sqrt(max(links.range2[0], 0.0)))
    wide = 2.0 * links.d[0] ** 2 / links.exponent[0] * np.sqrt(links.covariance(doubt)[0, 0])  # of radius^2
    sigma = wide / (radius + np.sqrt(radius**2 + wide))
    return Circle(float(links.xy[0, 0]), float(links.xy[0, 1]), radius, float(sigma))


def _place(links: Links, survey: Survey, settings: SolverSettings, theta: Array) -> Place:
    """Covariance and fit at a solution."""
    chi2 = Strengths(links, survey, settings).chi2(theta)
    covariance = expected_error(links, survey, settings, theta[:2])
    return Place(theta[:2].copy(), covariance, chi2, max(len(links.d) - 2, 0), float(theta[2]), float(theta[3]))


__all__ = [
    "LINK_N", "Circle", "Doubt", "Located", "Place", "Prior", "Received", "Solver", "SolverSettings", "Why", "locate",
    "shortest", "without_floor",
]  # fmt: skip
