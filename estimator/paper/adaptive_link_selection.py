"""Adaptive Link_n: the consistent subset of the shortest links, and the number of them with the smallest error.

A link with a blocked line of sight is weak, so it looks long: the shortest links are seldom wrong. From the first few
of them a set grows, link by link. Each next one has to be consistent with the position by the others. The number of
links is then the one with the smallest expected error for the solver in use.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Final

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.numerics.arrays import Array
from estimator.paper.lateration_model import Links, SolverSettings, expected_error, spread
from estimator.paper.lateration_solvers import DECIDED, SAME_M, Solution, Strengths, distinct, starts

SEEDS: Final = 5
"""Number of shortest links whose triples are tried until one is consistent with all other links."""
WEAKER: Final = 25.0
"""Increase of the smallest chi2 by which a link weaker than expected counts as blocked (5 sigma)."""
STRONGER: Final = 400.0
"""The same for a stronger link; light from a near wall adds to it, and only a moved or exchanged lamp exceeds this."""
RIVALS: Final = 3
"""Most positions kept while they all fit."""


def adapted(links: Links, survey: Survey, settings: SolverSettings) -> list[int]:
    """Indices in ``links`` (shortest first) to use, in that order; all of them where there are fewer than four."""
    if len(links.d) <= 3:
        return list(range(len(links.d)))
    agreeing, place = consistent(links, survey, settings)
    most = len(agreeing) if settings.link_n is None else min(len(agreeing), settings.link_n)
    if place is None or most <= 3:
        return agreeing[:most]
    errors = [
        float(np.trace(expected_error(links.pick(agreeing[:n]), survey, settings, place))) for n in range(3, most + 1)
    ]
    return agreeing[: 3 + int(np.argmin(errors))]


@dataclass(frozen=True, slots=True)
class Agreement:
    """Consistent links, with the positions that fit, best first; ``score``: chi2 and the cost of the excluded links."""

    links: list[int]
    places: list[Solution]
    score: float


def consistent(links: Links, survey: Survey, settings: SolverSettings) -> tuple[list[int], Array | None]:
    """The largest consistent set of links, shortest first, and its position (x, y); None if no triple fits."""
    best: Agreement | None = None
    for triple in combinations(range(min(SEEDS, len(links.d))), 3):
        if spread(links.pick(triple).xy)[0] < SAME_M:
            continue
        grown = _grown(links, survey, settings, list(triple))
        if grown is not None and (best is None or grown.score < best.score):
            best = grown
        if best is not None and best.score < WEAKER:  # excluding any link would cost more
            break
    if best is None:
        return list(range(len(links.d))), None
    return sorted(best.links), best.places[0][1][:2]


def _grown(links: Links, survey: Survey, settings: SolverSettings, triple: list[int]) -> Agreement | None:
    """A triple with every link consistent with it and with those added before; None if it fits no position."""
    few = links.pick(triple)
    fit = Strengths(few, survey, settings)
    found = distinct([fit.descend(np.array((*s, 0.0, survey.floor))) for s in starts(few)], DECIDED)[:RIVALS]
    if not found or found[0][0] > WEAKER:
        return None
    chosen, left_out = triple, 0.0
    for i in range(len(links.d)):
        if i not in triple:
            fit = Strengths(links.pick([*chosen, i]), survey, settings)
            more = distinct([fit.descend(theta) for _, theta in found], DECIDED)
            gate = WEAKER if _stronger(links, i, found[0][1]) < 0.0 else STRONGER
            if more and more[0][0] - found[0][0] < gate:
                chosen, found = [*chosen, i], more
            else:
                left_out += gate
    return Agreement(chosen, found, found[0][0] + left_out)


def _stronger(links: Links, i: int, theta: Array) -> float:
    """Logarithm of a link's RSS over the expected one at a position, all levelled."""
    d2 = float(np.sum((theta[:2] - links.xy[i]) ** 2)) + links.h[i] ** 2
    expected = (links.h[i] ** 2 / d2) ** (0.5 * links.exponent[i]) + theta[3]
    return float(-np.log(links.diffuse[i] * expected) - theta[2])
