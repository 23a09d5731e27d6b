"""Iterated EKF update (Eq. 5-7) with step halving, and noise inflation by the joint NIS.

The cost is the squared deviation from the prediction and from the links together. The iterated Kalman update is
Gauss-Newton on that sum. Beside a line of lamps, or between two lines, RSS hardly changes with the position across. A
full step from there overshoots, and the next one overshoots more. A step is therefore halved as long as that reduces
the cost. The result never costs more than the prediction.

The influence of one epoch is limited. Links may be likely one by one and impossible together: uncertain quantities
(gains, distance from the line) change all of them alike, but they have changed differently. The light has then changed,
as at a corner behind which other walls are lit. The state that explains it best is impossible. The noise is then
multiplied until the links together are no more improbable than one epoch in a thousand. Chang 2014, Journal of Geodesy
88:391, does so for an update that is not iterated.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np

from estimator.cdma.correlation_kernels import invert
from estimator.light_filter.measurement_update import OUT_COLUMNS, RESIDUAL, SLOT, WHITE, absorb, linearise
from estimator.light_filter.state_vector import COMMON, FIRST, OWN, YAW
from estimator.numerics import se2
from estimator.numerics.arrays import Array

NEAR_M, NEAR_RAD = 0.03, 0.03
"""Step (m, rad) below which the iteration ends."""
STEPS: Final = 8
"""Most iterations."""
SHORTEST: Final = 1.0 / 64.0
"""Shortest part of a step that is tried."""
IMPROBABLE: Final = 3.09
"""Standard deviations of one epoch in a thousand: the joint NIS exceeds it so rarely if the model holds."""
WIDER: Final = 4.0
"""Factor by which the noise is multiplied at a time."""
JITTER: Final = 1e-12
"""Variance added to elements without uncertainty, so that their deviation has a finite cost."""


class Seen(NamedTuple):
    """Links with the data for their comparison.

    Attributes:
        links: (L, LINK_COLUMNS). lamps: (slots, 7), rows of `lambertian.pack_lamps`. view: (VIEW_COLUMNS,), see
            `measurement_update.linearise`.
    """

    links: Array
    lamps: Array
    view: Array


def take_in(x: Array, P: Array, n: int, seen: Seen, out: Array, *, bounded: bool) -> float:
    """Update the state with links, linearised again where the result is far from the linearisation point.

    Args:
        x: state, changed in place.
        P: its covariance, changed in place.
        n: elements in use.
        seen: the links.
        out: (L, OUT_COLUMNS) of `linearise` at ``x``, with the noise of each link (infinite: not used). The noise is
            multiplied where the links are improbable together.
        bounded: whether to inflate the noise. It is False while hypotheses compete, where improbable links are
            evidence.

    Returns:
        ln of the likelihood of these links at the prediction, with their original noise.
    """
    used = out[:, WHITE] < math.inf
    if not np.any(used):
        return 0.0
    before = x.copy(), P.copy()
    likelihood, left = _iterate((x, P), before, n, seen, out)
    if not bounded or left <= (most := nis_bound(int(np.count_nonzero(used)))):
        return likelihood
    white = out[used, WHITE]
    factor, enough = 1.0, float(np.sum(out[used, RESIDUAL] ** 2 / white)) / most  # at this the prediction passes
    while left > most and factor < enough:
        factor = min(WIDER * factor, enough)
        out[used, WHITE] = factor * white
        x[:], P[:] = before
        _, left = _iterate((x, P), before, n, seen, out)
    return likelihood


def nis_bound(links: int) -> float:
    """NIS that ``links`` links exceed once in a thousand epochs: chi-square quantile by Wilson and Hilferty (1931)."""
    spread = 2.0 / (9.0 * links)
    return links * float(1.0 - spread + IMPROBABLE * math.sqrt(spread)) ** 3


def _iterate(
    state: tuple[Array, Array], before: tuple[Array, Array], n: int, seen: Seen, out: Array
) -> tuple[float, float]:
    """Iterated update in place; returns ln of the likelihood at the prediction ``before``, and the final cost."""
    (x, P), (x0, P0) = state, before
    likelihood, nis = absorb(x, P, n, x0, seen.links, out)
    if _near(x, x0):
        return likelihood, nis
    price = _Price(x0, P0, seen.links, out)
    around, cost = x0, price.of(x0, out)
    for _ in range(STEPS):
        further = _further(price, around, x, cost, seen)
        if further is None:
            break
        around, cost, out = further
        x[:], P[:] = before
        absorb(x, P, n, around, seen.links, out)
        if _near(x, around):
            return likelihood, price.of(x, price.look(x, seen))
    x[:] = around  # the last step did not reduce the cost; P is the covariance at ``around``
    return likelihood, cost


class _Price:
    """Cost of a state: squared deviations from the prediction and from the links in use, each over its variance.

    States differ from the prediction by ``P0 H'`` times a vector. The elements that links depend on determine them.
    """

    def __init__(self, x0: Array, P0: Array, links: Array, out: Array) -> None:
        """``x0``, ``P0``: prediction; ``links``, ``out``: see `take_in`."""
        self._x0, self._P0 = x0, P0
        self._used = out[:, WHITE] < math.inf
        self._white = out[:, WHITE].copy()
        own = FIRST + OWN * links[self._used, SLOT].astype(np.int64)[:, None] + np.arange(OWN)
        self._at = np.concatenate((np.arange(3), np.arange(COMMON, FIRST), own.ravel()))
        self._L = P0[np.ix_(self._at, self._at)] + JITTER * np.eye(len(self._at))
        invert(self._L)

    def look(self, x: Array, seen: Seen) -> Array:
        """`linearise` of the links at ``x``, with their assigned noise."""
        out = np.zeros((len(seen.links), OUT_COLUMNS))
        linearise(x, self._P0, *seen, out)
        out[:, WHITE] = self._white
        return out

    def of(self, x: Array, out: Array) -> float:
        """Cost of ``x``; ``out``: `linearise` of the links at ``x``."""
        off = x - self._x0
        off[YAW] = se2.wrap(float(off[YAW]))
        off, r = off[self._at], out[self._used, RESIDUAL]
        prior = np.sum(off[:, None] * self._L * off)  # not by a matrix product, which would start BLAS threads
        return float(prior + np.sum(r * r / self._white[self._used]))


def _further(price: _Price, around: Array, x: Array, cost: float, seen: Seen) -> tuple[Array, float, Array] | None:
    """Cheapest state between ``around`` and ``x`` by step halving: state, cost, links; None if none is cheaper."""
    step = x - around
    step[YAW] = se2.wrap(float(step[YAW]))
    part, best = 1.0, None
    while part >= SHORTEST:
        there = around + part * step
        there[YAW] = se2.wrap(float(there[YAW]))
        out = price.look(there, seen)
        less = price.of(there, out)
        if less < cost:
            best, cost = (there, less, out), less
        elif best is not None:
            break
        part *= 0.5
    return best


def _near(x: Array, around: Array) -> bool:
    """Whether two states differ by less than `NEAR_M` and `NEAR_RAD`."""
    step = x[:3] - around[:3]
    return math.hypot(*step[:2].tolist()) < NEAR_M and abs(se2.wrap(float(step[2]))) < NEAR_RAD
