"""The three solvers of Eq. 4 (`ls`, `lin`, `ml`): from links to the positions that fit, best first."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

import numpy as np

from estimator.light_filter.survey import Survey
from estimator.numerics.arrays import Array
from estimator.paper.lateration_kernels import by_range, by_strength, strength_step
from estimator.paper.lateration_model import Links, Solver, SolverSettings, in_line, spread

DECIDED: Final = 6.0
"""Difference of chi2 at which the worse of two positions is discarded: likelihoods 20 to 1."""
SAME_M: Final = 0.02
"""Distance (m) within which two descents have found the same position."""

Solution = tuple[float, Array]
"""Cost, and x, y of the receiver (m), common ln gain, floor."""


def solve(links: Links, survey: Survey, settings: SolverSettings) -> list[Array]:
    """Positions that fit at least two links of separate lamps, as (x, y, common ln gain, floor), best first."""
    return SOLVERS[settings.solver](links, survey, settings)


def mirrored(xy: Array, place: Array) -> Array:
    """Mirror image of ``place`` in the main axis of lamps at ``xy``."""
    centre, axis = xy.mean(axis=0), spread(xy)[2]
    off = place - centre
    image: Array = centre + 2.0 * (off @ axis) * axis - off
    return image


def linear(links: Links) -> list[Array]:
    """Eq. 3, differences from the mean over all links: one position, or the mirror pair for collinear lamps."""
    centre = links.xy.mean(axis=0)
    xy = links.xy - centre
    right = np.sum(xy**2, axis=1) - links.range2
    right = right - right.mean()
    if not in_line(links.xy):
        a, b, c = float(xy[:, 0] @ xy[:, 0]), float(xy[:, 0] @ xy[:, 1]), float(xy[:, 1] @ xy[:, 1])
        u, v = xy.T @ right
        return [centre + np.array((c * u - b * v, a * v - b * u)) / (2.0 * (a * c - b * b))]
    axis = spread(links.xy)[2]
    along = xy @ axis
    u = float(along @ right) / float(2.0 * along @ along)
    v = float(np.sqrt(max(np.mean(links.range2 - (u - along) ** 2), 0.0)))
    across = np.array((-axis[1], axis[0]))
    return [centre + u * axis + v * across, centre + u * axis - v * across][: 2 if v > SAME_M else 1]


def starts(links: Links) -> list[Array]:
    """Starts of the descents: the linear solution, its mirror image, and the centre of the lamps."""
    found = linear(links)
    return [*found, mirrored(links.xy, found[0]), links.xy.mean(axis=0) + SAME_M]


def distinct(found: Sequence[Solution], margin: float) -> list[Solution]:
    """Ends of descents, best first, no position twice, none worse than the best by ``margin`` or more."""
    settled = sorted((f for f in found if np.isfinite(f[0])), key=lambda f: f[0])
    kept: list[Solution] = []
    for cost, theta in settled:
        if cost - settled[0][0] < margin and all(np.hypot(*(theta - k)[:2]) > SAME_M for _, k in kept):
            kept.append((cost, theta))
    return kept


class Strengths:
    """Weighted fit of ln RSS, with the common gain and the floor as unknowns that have priors."""

    def __init__(self, links: Links, survey: Survey, settings: SolverSettings) -> None:
        doubt = settings.doubt
        gain, floor = (1.0 / max(sigma, 1e-6) ** 2 for sigma in (doubt.common_ln, doubt.floor))
        self._table, self._rx = links.table, links.rx.copy()
        self._rx[6] = -1.0  # received lamps are in view: descents need no cliff at the edge of the field of view
        self._data = np.vstack((np.log(links.amplitude), 1.0 / links.variance))
        self._prior = np.array((settings.yaw, 0.0, gain, survey.floor, floor))
        self._system = np.empty((4, 5))

    def chi2(self, theta: Array) -> float:
        """chi2 of a solution, priors included."""
        return float(strength_step(self._table, self._rx, self._data, self._prior, theta, self._system))

    def descend(self, theta: Array) -> Solution:
        """Descend from a start to a minimum; cost inf where none was reached."""
        end = theta.copy()
        return by_strength(self._table, self._rx, self._data, self._prior, end, self._system), end


def _by_lines(links: Links, survey: Survey, settings: SolverSettings) -> list[Array]:
    return [np.array((*p, 0.0, survey.floor)) for p in linear(links)]


def _by_range(links: Links, survey: Survey, settings: SolverSettings) -> list[Array]:
    """Eq. 4: the smallest of its minima, or both of a mirror pair."""
    data, system = np.vstack((links.range2, np.ones(len(links.d)))), np.empty((2, 3))
    found = []
    for start in starts(links):
        theta = np.array(start)
        found.append((by_range(links.table, data, theta, system), np.array((*theta, 0.0, survey.floor))))
    ends = [theta for _, theta in distinct(found, np.inf)]
    return ends[: 2 if in_line(links.xy) else 1]


def _by_strength(links: Links, survey: Survey, settings: SolverSettings) -> list[Array]:
    """Every minimum that is not clearly worse than the best."""
    fit = Strengths(links, survey, settings)
    found = [fit.descend(np.array((*start, 0.0, survey.floor))) for start in starts(links)]
    return [theta for _, theta in distinct(found, DECIDED)]


SOLVERS: Final[dict[Solver, Callable[[Links, Survey, SolverSettings], list[Array]]]] = {
    Solver.LS: _by_range,
    Solver.LIN: _by_lines,
    Solver.ML: _by_strength,
}
