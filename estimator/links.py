"""Eq. 3 and 4: from the strengths of a few lamps to a place, with shortest-link selection and its uncertainty.

Eq. 3    (x_i - x)^2 + (y_i - y)^2 = d_i^2 - h_i^2,    d_i by inversion of Eq. 1, 2 for level lamps and receiver
Eq. 4    place = argmin sum over the Link_n shortest links of [(x_i - x)^2 + (y_i - y)^2 - (d_i^2 - h_i^2)]^2

Three solvers: `ls` is Eq. 4 as it stands; `lin` takes differences of Eq. 3, which are linear; `ml` fits logarithms of
strengths, each weighted by how well it can be known, with the common gain and the diffuse floor as unknowns of their
own. Uncertainty is propagated from one model of what is not known (:class:`Doubt`), whichever solver is used.

Places are those of the receiver (the photodiode), in the survey's frame, m.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from enum import Enum
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.lamps import Lamp, Survey
from estimator.links_fit import by_range, by_strength, strength_step
from estimator.optics import LEAST_HEIGHT_M, pack_lamps, pack_receiver
from estimator.records import Array

Index = npt.NDArray[np.int64]

LINK_N: Final = 4
"""The paper's number of links."""
DECIDED: Final = 6.0
"""Difference of chi2 from which the worse of two places is given up: likelihoods 20 to 1."""
SAME_M: Final = 0.02
"""Two descents that end this close have found the same place."""
SANE: Final = (1e-6, 1e3)
"""Strengths outside these bounds, relative to that right below the lamp, are no light of this lamp."""
IN_LINE: Final = 0.02
"""Lamps whose spread across their line is less than this part of that along it stand in a line."""


class Solver(Enum):
    """How a place is found."""

    LS = "ls"
    LIN = "lin"
    ML = "ml"


class Why(Enum):
    """What the places of a result are."""

    PLACE = "one place fits"
    MIRROR = "two places fit, the lamps alone do not tell which"
    PRIOR = "two places fit, the prior knowledge tells which"
    CIRCLE = "one lamp: every place on a circle around it fits"
    NONE = "no usable link"
    NO_FIT = "no descent settled"


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
class Method:
    """How to solve.

    Attributes:
        link_n: how many of the shortest links to use; None: all. adaptive: choose the number (up to ``link_n``) by
            the error it is expected to leave.
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


@dataclass(frozen=True, slots=True, eq=False)
class Prior:
    """What is known of the receiver's place beforehand: ``xy`` (2,) and ``covariance`` (2, 2)."""

    xy: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class Place:
    """One place that fits.

    Attributes:
        xy: (2,) m. covariance: (2, 2) m^2, expected squared error under the :class:`Doubt`.
        chi2, freedom: of the residuals of ln strength under the same; freedom 0 where nothing is left over to judge.
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
    """Around a single lamp; ``sigma`` of the radius, m."""

    x: float
    y: float
    radius: float
    sigma: float


@dataclass(frozen=True, slots=True, eq=False)
class Located:
    """Result: places (best first; more than one only with `Why.MIRROR`), used links, shortest first."""

    why: Why
    places: tuple[Place, ...] = ()
    circle: Circle | None = None
    used: tuple[int, ...] = ()


def strength_below(lamps: Sequence[Lamp], survey: Survey) -> Array:
    """(n,) A, amplitude right below each lamp, levelled, without floor."""
    table, rx = pack_lamps(lamps, survey.depth), pack_receiver(survey.receiver)
    h = np.maximum(table[:, 2] - rx[2], LEAST_HEIGHT_M)
    below: Array = table[:, 3] * rx[4] * (table[:, 4] + 1.0) * rx[3] / (2.0 * np.pi * h**2)
    return below


class Geometry:
    """Per-link quantities that every step needs, arrays of one element per link."""

    def __init__(self, received: Received, survey: Survey, doubt: Doubt) -> None:
        table, rx = pack_lamps(received.lamps, survey.depth), pack_receiver(survey.receiver)
        self.xy, self.table, self.rx = table[:, :2], table, rx
        self.h = np.maximum(table[:, 2] - rx[2], LEAST_HEIGHT_M)
        self.amplitude = received.amplitude
        self.exponent = table[:, 4] + rx[5] + 2.0
        below = strength_below(received.lamps, survey)
        self.d = self.h * (below / self.amplitude) ** (1.0 / self.exponent)
        self.range2 = self.d**2 - self.h**2
        self.rim = below * max(rx[6], 0.0) ** self.exponent
        self.diffuse = below / self.amplitude  # of the received strength, per unit of floor
        tan = np.sqrt(np.maximum(self.range2, 0.0)) / self.h
        own = np.array([lamp.sigma_ln for lamp in received.lamps])
        noise = received.variance / self.amplitude**2
        model = own**2 + (doubt.tilt * tan) ** 2 + (doubt.floor_own * self.diffuse) ** 2
        self.variance = noise + model + 1e-12

    def covariance(self, doubt: Doubt) -> Array:
        """(n, n) of ln strength, what links share included."""
        shared = doubt.common_ln**2 + doubt.floor**2 * np.outer(self.diffuse, self.diffuse)
        total: Array = np.diag(self.variance) + shared
        return total


def without_floor(received: Received, survey: Survey) -> Received:
    """The same with the survey's diffuse floor taken off (at most 95 % of a link)."""
    g = Geometry(received, survey, Doubt())
    share = np.minimum(survey.floor * g.diffuse, 0.95)
    return Received(received.lamps, received.amplitude * (1.0 - share), received.variance)


def shortest(received: Received, survey: Survey, rim: float = 0.0) -> tuple[int, ...]:
    """Usable links (positive, finite, not below ``rim``), the shortest first; equal lamps: the strongest first."""
    below = strength_below(received.lamps, survey)
    with np.errstate(invalid="ignore"):  # a strength that is not a number is not within bounds, and says no more
        fit = (received.amplitude > SANE[0] * below) & (received.amplitude < SANE[1] * below)
        fit &= (received.variance >= 0.0) & (received.variance < (SANE[1] * below) ** 2)
    some = [int(i) for i in np.flatnonzero(fit)]
    if not some:
        return ()
    g = Geometry(received.pick(some), survey, Doubt())
    order = np.argsort(g.d, kind="stable")
    return tuple(some[i] for i in order if g.amplitude[i] >= rim * g.rim[i])


def locate(received: Received, survey: Survey, method: Method | None = None, prior: Prior | None = None) -> Located:
    """Where the receiver is according to these strengths; never raises for bad geometry, but says what is not known.

    With two links, or lamps in a line, two places fit that mirror each other: ``prior`` chooses, where it can.
    """
    method = Method() if method is None else method
    used = shortest(received, survey, method.rim)
    if method.adaptive:
        used = used[: best_count(received, survey, method)]
    used = used[: method.link_n]
    if not used:
        return Located(Why.NONE)
    chosen = received.pick(used)
    g = Geometry(chosen, survey, method.doubt)
    if len(used) == 1 or _spread(g.xy)[0] < SAME_M:
        return Located(Why.CIRCLE, (), _circle(g, method.doubt), used)
    found = {Solver.LS: _by_range, Solver.LIN: _by_lines, Solver.ML: _by_strength}[method.solver](g, survey, method)
    places = [_place(g, survey, method, theta) for theta in found]
    return _decide(places, used, prior)


def _decide(places: list[Place], used: tuple[int, ...], prior: Prior | None) -> Located:
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


def _circle(g: Geometry, doubt: Doubt) -> Circle:
    radius = float(np.sqrt(max(g.range2[0], 0.0)))
    spread = 2.0 * g.d[0] ** 2 / g.exponent[0] * np.sqrt(g.covariance(doubt)[0, 0])  # of the squared radius
    sigma = spread / (radius + np.sqrt(radius**2 + spread))
    return Circle(float(g.xy[0, 0]), float(g.xy[0, 1]), radius, float(sigma))


def _spread(xy: Array) -> tuple[float, float, Array]:
    """Standard deviations along and across the lamps' main axis, and that axis."""
    centred = xy - xy.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)
    size = np.append(size, 0.0) / np.sqrt(len(xy))
    return float(size[0]), float(size[1]), axes[0]


def _mirrored(xy: Array, place: Array) -> Array:
    """``place`` seen in the lamps' main axis as in a mirror."""
    axis = _spread(xy)[2]
    off = place - xy.mean(axis=0)
    image: Array = xy.mean(axis=0) + 2.0 * (off @ axis) * axis - off
    return image


def _in_line(xy: Array) -> bool:
    along, across, _ = _spread(xy)
    return across < IN_LINE * along


def _linear(g: Geometry) -> list[Array]:
    """Eq. 3, differences from the mean over all links: one place, or the mirror pair for lamps in a line."""
    centre = g.xy.mean(axis=0)
    xy = g.xy - centre
    right = np.sum(xy**2, axis=1) - g.range2
    right = right - right.mean()
    if not _in_line(g.xy):
        return [centre + np.linalg.lstsq(2.0 * xy, right)[0]]
    axis = _spread(g.xy)[2]
    along = xy @ axis
    u = float(along @ right) / float(2.0 * along @ along)
    v = float(np.sqrt(max(np.mean(g.range2 - (u - along) ** 2), 0.0)))
    across = np.array((-axis[1], axis[0]))
    return [centre + u * axis + v * across, centre + u * axis - v * across][: 2 if v > SAME_M else 1]


def _starts(g: Geometry) -> list[Array]:
    """Where descents begin: the linear solution, its mirror image, and the middle of the lamps."""
    linear = _linear(g)
    return [*linear, _mirrored(g.xy, linear[0]), g.xy.mean(axis=0) + SAME_M]


def _by_lines(g: Geometry, survey: Survey, method: Method) -> list[Array]:
    return [np.array((*p, 0.0, survey.floor)) for p in _linear(g)]


def _distinct(found: list[tuple[float, Array]], margin: float) -> list[Array]:
    """Ends of descents, best first, no place twice, none worse than the best by ``margin`` or more."""
    found = sorted((f for f in found if np.isfinite(f[0])), key=lambda f: f[0])
    kept: list[Array] = []
    for cost, theta in found:
        if cost - found[0][0] < margin and all(np.hypot(*(theta - k)[:2]) > SAME_M for k in kept):
            kept.append(theta)
    return kept


def _by_range(g: Geometry, survey: Survey, method: Method) -> list[Array]:
    """Eq. 4: the least of its minima, or both of a mirror pair."""
    data, system = np.vstack((g.range2, np.ones(len(g.d)))), np.empty((2, 3))
    found = []
    for start in _starts(g):
        theta = np.array(start)
        found.append((by_range(g.table, data, theta, system), np.array((*theta, 0.0, survey.floor))))
    return _distinct(found, np.inf)[: 2 if _in_line(g.xy) else 1]


def _by_strength(g: Geometry, survey: Survey, method: Method) -> list[Array]:
    """Weighted fit of ln strength; every minimum that is not clearly worse than the best."""
    data, system = np.vstack((np.log(g.amplitude), 1.0 / g.variance)), np.empty((4, 5))
    rx, prior = _wide(g.rx), _nuisance(survey, method)
    found = []
    for start in _starts(g):
        theta = np.array((*start, 0.0, survey.floor))
        found.append((by_strength(g.table, rx, data, prior, theta, system), theta))
    return _distinct(found, DECIDED)


def _wide(rx: Array) -> Array:
    """The receiver with no edge to its field of view: what is received has been seen, and descents need no cliffs."""
    wide = rx.copy()
    wide[6] = -1.0
    return wide


def _nuisance(survey: Survey, method: Method) -> Array:
    """Yaw, and what is known of common gain and floor, for `strength_step`."""
    doubt = method.doubt
    weights = [1.0 / max(sigma, 1e-6) ** 2 for sigma in (doubt.common_ln, doubt.floor)]
    return np.array((method.yaw, 0.0, weights[0], survey.floor, weights[1]))


def _place(g: Geometry, survey: Survey, method: Method, theta: Array) -> Place:
    """Uncertainty and fit at a solution."""
    data, system = np.vstack((np.log(g.amplitude), 1.0 / g.variance)), np.empty((4, 5))
    chi2 = strength_step(g.table, _wide(g.rx), data, _nuisance(survey, method), theta, system)
    covariance = expected_error(g, survey, method, theta[:2])
    return Place(theta[:2].copy(), covariance, float(chi2), max(len(g.d) - 2, 0), float(theta[2]), float(theta[3]))


def expected_error(g: Geometry, survey: Survey, method: Method, xy: Array) -> Array:
    """(2, 2) expected squared error of a solver at ``xy``, m^2: its sensitivity to errors times their covariance.

    `ls` and `lin` do not know of the floor: what it does to them is a bias, and counted in. No direction is more
    uncertain than the curvature of the circles allows (lamps in a line, the place between them).
    """
    off = xy - g.xy
    d2 = np.sum(off**2, axis=1) + g.h**2
    errors = g.covariance(method.doubt)
    if method.solver is Solver.ML:
        J = -(g.exponent / d2)[:, None] * off
        covariance = _capped_inverse(J.T @ np.linalg.solve(errors, J))
    else:
        direct = (g.h**2 / d2) ** (0.5 * g.exponent)
        bias = np.log1p(survey.floor / direct)
        swing = 2.0 * d2 / g.exponent
        moment = np.outer(swing, swing) * (errors + np.outer(bias, bias))
        differences = method.solver is Solver.LIN and not _in_line(g.xy)
        covariance = _sandwich(2.0 * (off - off.mean(axis=0) if differences else off), moment)
    size, axes = np.linalg.eigh(covariance)
    widest = float(np.mean(2.0 * d2 / g.exponent * np.sqrt(np.diag(errors))))
    capped: Array = (axes * np.clip(size, 1e-12, widest)) @ axes.T
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


def best_count(received: Received, survey: Survey, method: Method) -> int:
    """Adaptive Link_n: how many of the shortest links leave the least expected error (at most ``link_n``).

    The error of each number is predicted at the place that all links together give, by `expected_error`.
    """
    used = shortest(received, survey, method.rim)
    most = len(used) if method.link_n is None else min(len(used), method.link_n)
    if most <= 3:
        return most
    everything = Method(Solver.ML, None, False, method.doubt, method.rim, method.yaw)
    found = locate(received, survey, everything)
    if not found.places:
        return most
    at = found.places[0].xy
    traces = []
    for n in range(3, most + 1):
        g = Geometry(received.pick(used[:n]), survey, method.doubt)
        traces.append(float(np.trace(expected_error(g, survey, method, at))))
    return 3 + int(np.argmin(traces))
