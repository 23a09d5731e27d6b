"""The shortest-link mechanism (Sect. 2): receiver position, or a pause of light, from the links of one epoch.

    links -> lamps by code -> clear links S -> the Link_n shortest -> Eq. 3, 4 -> position of the receiver

A single link is paused if its lamp is not known, or if it is too faint. It is also paused if it is too weak for a line
of sight; it is then not in S. Light as a whole is paused where fewer than Link_n links are clear: ``|S| < Link_n``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from estimator.cdma.epoch import UNUSABLE, LightEpoch, LinkFlag
from estimator.light_filter.lamp_catalogue import Catalogue
from estimator.light_filter.survey import Lamp, Survey
from estimator.numerics.arrays import Array
from estimator.paper.lateration import Place, Prior, Why, locate
from estimator.paper.lateration_model import Links, Received, SolverSettings, usable
from estimator.result import Link, LinkState

FAINT: Final = 5.0
"""Ratio of RSS to its noise sigma below which a link is faint."""


@dataclass(frozen=True, slots=True, eq=False)
class ReceivedLink:
    """One link of an epoch: its lamp, None where that is not known, and whether it may be used."""

    code: int
    rss: float
    variance: float
    lamp: Lamp | None
    state: LinkState


@dataclass(frozen=True, slots=True, eq=False)
class Selection:
    """Result of the selection in one epoch.

    Attributes:
        received: every link, the strongest first.
        clear: S, as indices in ``received``, the shortest link first.
        used: the Link_n shortest of S as input of the solvers; None where light is paused.
        position: of the receiver by Eq. 3, 4; None where light is paused or the lamps leave it ambiguous.
    """

    received: tuple[ReceivedLink, ...]
    clear: tuple[int, ...]
    used: Links | None = None
    position: Place | None = None

    @property
    def accepted(self) -> frozenset[int]:
        """Numbers of the lamps whose links determine the position; empty without a position."""
        if self.used is None or self.position is None:
            return frozenset()
        lamps = (self.received[self.clear[i]].lamp for i in range(len(self.used.d)))
        return frozenset(lamp.lamp_id for lamp in lamps if lamp is not None)


PAUSED: Final = Selection((), ())


def select(
    epoch: LightEpoch, catalogue: Catalogue, survey: Survey, settings: SolverSettings, prior: Prior | None
) -> Selection:
    """Position by the Link_n shortest links of an epoch.

    Args:
        epoch: from the decoder.
        catalogue: the lamps; those that send their own data in this epoch are added.
        survey: receiver and depth.
        settings: solver and Link_n.
        prior: prior position of the receiver, to separate lamps of one code and mirror images; None: not known.
    """
    if epoch.block & UNUSABLE:
        return PAUSED
    rows = [received_link(epoch, k, catalogue, prior) for k in range(len(epoch.ids))]
    rows.sort(key=lambda one: -one.rss)
    fit = [k for k, one in enumerate(rows) if one.state is LinkState.ACCEPTED]
    received = Received(
        tuple(lamp for k in fit if (lamp := rows[k].lamp) is not None),
        np.array([rows[k].rss for k in fit]),
        np.array([rows[k].variance for k in fit]),
    )
    links = usable(received, survey, settings)
    clear = tuple(fit[i] for i in links.at.tolist())
    n = len(clear) if settings.link_n is None else settings.link_n
    if len(clear) < max(n, 1):
        return Selection(tuple(rows), clear)
    located = locate(received, survey, settings, prior)
    position = located.places[0] if located.why in (Why.PLACE, Why.PRIOR) else None
    return Selection(tuple(rows), clear, links.pick(range(n)), position)


def received_link(epoch: LightEpoch, k: int, catalogue: Catalogue, prior: Prior | None) -> ReceivedLink:
    """The ``k``-th link of an epoch with its lamp."""
    code, flags = int(epoch.ids[k]), int(epoch.flags[k])
    rss, variance = float(epoch.amplitude[k]), float(epoch.variance[k])
    if not (0.0 < rss < math.inf and 0.0 <= variance < math.inf):
        return ReceivedLink(code, 0.0, math.inf, None, LinkState.FAINT)
    frame = epoch.lamps[k]
    lamps = catalogue.candidates(code) if frame is None else [catalogue.learn(frame, code, epoch.t_end)[0]]
    if not lamps:
        return ReceivedLink(code, rss, variance, None, LinkState.UNSURVEYED)
    duplicate = len(lamps) > 1 and (prior is None or bool(flags & LinkFlag.TWIN))
    lamp = lamps[0] if prior is None else nearest(lamps, prior.xy)
    if flags & LinkFlag.FAINT or rss <= FAINT * math.sqrt(variance):
        return ReceivedLink(code, rss, variance, lamp, LinkState.FAINT)
    return ReceivedLink(code, rss, variance, lamp, LinkState.TWIN if duplicate else LinkState.ACCEPTED)


def nearest(lamps: list[Lamp], xy: Array) -> Lamp:
    """The lamp nearest to a position."""
    return min(lamps, key=lambda lamp: math.hypot(lamp.x - float(xy[0]), lamp.y - float(xy[1])))


def links_of(selection: Selection, settings: SolverSettings, xy: Array | None) -> tuple[Link, ...]:
    """The links as results, strongest first; residuals for the receiver at ``xy`` (None: not known)."""
    used = (
        set() if selection.position is None or selection.used is None else set(selection.clear[: len(selection.used.d)])
    )
    residuals = dict[int, tuple[float, float]]()
    if xy is not None and selection.used is not None:
        both = zip(*deviations(selection.used, settings, xy), strict=True)
        residuals = dict(zip(selection.clear, ((float(r), float(s)) for r, s in both), strict=False))
    found = []
    for k, one in enumerate(selection.received):
        state = one.state
        if state is LinkState.ACCEPTED:
            state = LinkState.RIM if k not in selection.clear else state if k in used else LinkState.PAUSED
        lamp_id = None if one.lamp is None or state is LinkState.TWIN else one.lamp.lamp_id
        found.append(Link(one.code, lamp_id, state, one.rss, *residuals.get(k, (None, None))))
    return tuple(found)


def deviations(links: Links, settings: SolverSettings, xy: Array) -> tuple[Array, Array]:
    """Residuals (n,) of ln RSS with the receiver at ``xy``, and one sigma (n,) of each."""
    return links.residuals(xy), np.sqrt(np.diag(links.covariance(settings.doubt)))


def misfit(links: Links, settings: SolverSettings, xy: Array) -> float:
    """Mean squared normalised residual of the links with the receiver at ``xy`` (Eq. 6); 1 is expected."""
    residual, sigma = deviations(links, settings, xy)
    return float(np.mean(np.square(residual / sigma)))
