"""Eq. 5-7 where the equations bend: the update is repeated around its own outcome, no farther than it betters the fit.

What is minimised is the squared deviation from the prediction and from the links together (an iterated Kalman update is
Gauss and Newton's way down that sum). Beside a row of lamps, or between two of them, strengths hardly change with the
place across: a full step from there overshoots, and the next one from where it has come to more so. A step is therefore
halved as long as that helps, and the state never ends where the sum is larger than it is at the prediction.

Nor does one epoch lead it farther than it may be. Links may be likely one by one and impossible together: what is
uncertain (gains, the distance from a row) moves all of them alike, and they have moved apart. Then light has changed,
as at a corner behind which other walls are lit, and what explains it best is a state that cannot be. Their noise is
multiplied then until all of it together is no more improbable than one epoch in a thousand (Chang 2014, Journal of
Geodesy 88:391, for an update that is not iterated).
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
"""A step of less needs no other."""
STEPS: Final = 8
SHORTEST: Final = 1.0 / 64.0
"""Part of a step below which it is not worth going."""
IMPROBABLE: Final = 3.09
"""Standard deviations: once in a thousand epochs, links together are farther off if all is as it is taken to be."""
WIDER: Final = 4.0
"""By that factor noise is multiplied at a time."""
JITTER: Final = 1e-12
"""Variance that is added to elements which are known for certain, so that a deviation of them has a price."""


class Seen(NamedTuple):
    """Links and what they are compared by.

    Attributes:
        links: (L, LINK_COLUMNS). lamps: (slots, 7), rows of `lambertian.pack_lamps`. view: (VIEW_COLUMNS,), see
            `measurement_update.linearise`.
    """

    links: Array
    lamps: Array
    view: Array


def take_in(x: Array, P: Array, n: int, seen: Seen, out: Array, *, bounded: bool) -> float:
    """Take links in, linearised anew where the outcome lies far from where they were.

    Args:
        x: state, changed in place.
        P: its covariance, changed in place.
        n: elements in use.
        seen: the links.
        out: (L, OUT_COLUMNS) of `linearise` at ``x``, with the noise that each link is given (infinite: left out);
            where they are improbable together it is multiplied.
        bounded: whether that is done. Where hypotheses are compared, what is improbable speaks against one of them.

    Returns:
        ln of the likelihood of these links at the prediction, with the noise that they came with.
    """
    used = out[:, WHITE] < math.inf
    if not np.any(used):
        return 0.0
    before = x.copy(), P.copy()
    likelihood, left = _iterate((x, P), before, n, seen, out)
    if not bounded or left <= (most := nis_bound(int(np.count_nonzero(used)))):
        return likelihood
    white = out[used, WHITE]
    factor, enough = 1.0, float(np.sum(out[used, RESIDUAL] ** 2 / white)) / most  # enough for the prediction itself
    while left > most and factor < enough:
        factor = min(WIDER * factor, enough)
        out[used, WHITE] = factor * white
        x[:], P[:] = before
        _, left = _iterate((x, P), before, n, seen, out)
    return likelihood


def nis_bound(links: int) -> float:
    """What the NIS of so many links exceeds once in a thousand: chi-square's quantile by Wilson and Hilferty (1931)."""
    spread = 2.0 / (9.0 * links)
    return links * float(1.0 - spread + IMPROBABLE * math.sqrt(spread)) ** 3


def _iterate(
    state: tuple[Array, Array], before: tuple[Array, Array], n: int, seen: Seen, out: Array
) -> tuple[float, float]:
    """The update, in place; ln of the likelihood at the prediction ``before``, and the sum that is left in the end."""
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
    x[:] = around  # the last step led nowhere better: P is what the links tell there
    return likelihood, cost


class _Price:
    """Sum of squared deviations, each over its variance, of a state from the prediction and from the links in use.

    States that differ from the prediction by ``P0 H'`` times anything are told by those elements that links depend on.
    """

    def __init__(self, x0: Array, P0: Array, links: Array, out: Array) -> None:
        self._x0, self._P0 = x0, P0
        self._used = out[:, WHITE] < math.inf
        self._white = out[:, WHITE].copy()
        own = FIRST + OWN * links[self._used, SLOT].astype(np.int64)[:, None] + np.arange(OWN)
        self._at = np.concatenate((np.arange(3), np.arange(COMMON, FIRST), own.ravel()))
        self._L = P0[np.ix_(self._at, self._at)] + JITTER * np.eye(len(self._at))
        invert(self._L)

    def look(self, x: Array, seen: Seen) -> Array:
        """What `linearise` says of the links at ``x``, with the noise that they were given."""
        out = np.zeros((len(seen.links), OUT_COLUMNS))
        linearise(x, self._P0, *seen, out)
        out[:, WHITE] = self._white
        return out

    def of(self, x: Array, out: Array) -> float:
        """``out``: what `linearise` says of the links at ``x``."""
        off = x - self._x0
        off[YAW] = se2.wrap(float(off[YAW]))
        off, r = off[self._at], out[self._used, RESIDUAL]
        prior = np.sum(off[:, None] * self._L * off)  # not by a matrix product, which would wake BLAS threads
        return float(prior + np.sum(r * r / self._white[self._used]))


def _further(price: _Price, around: Array, x: Array, cost: float, seen: Seen) -> tuple[Array, float, Array] | None:
    """Where it is cheapest between ``around`` and ``x``, halving the way: there, its cost, the links; None: nowhere."""
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
    step = x[:3] - around[:3]
    return math.hypot(*step[:2].tolist()) < NEAR_M and abs(se2.wrap(float(step[2]))) < NEAR_RAD
