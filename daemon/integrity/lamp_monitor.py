"""Lamp monitor: faults of lamps and survey from the links of every epoch; each is logged once, with the lamp's number.

A lamp is judged by how long the same thing has been said of it. What has been found stays until that lamp is received
as it should be, for the robot may not come by again for a while.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Final

from daemon.health.faults import Fault
from estimator import UNUSABLE, BlockFlag, Fix, LightsResult, Link, LinkState

log = logging.getLogger(__name__)

LASTS_S: Final = 10.0
"""For how long all must be so, and lamps must be odd, until it is no passing shadow."""
TWIN_S: Final = 3.0
"""Two lamps with one code; while one of them comes and the other goes they look like it for a moment."""
OVER_S: Final = 3.0
"""For how long it must have been otherwise until it is over."""
FORGOTTEN_S: Final = 600.0
"""What was found of a lamp that has not been seen since is forgotten."""
ENOUGH: Final = 3
"""Links that make a majority worth the name."""

_ODD: Final = ((LinkState.REJECTED, Fault.LAMP_MOVED), (LinkState.MISSING, Fault.LAMP_DEAD))
_UNHEARD: Final = (LinkState.FAINT, LinkState.MISSING)
_SAID: Final = {
    Fault.LAMP_MOVED: "does not shine as surveyed: moved, exchanged, or its power is another",
    Fault.LAMP_DEAD: "is not received where it must be: dead, switched off, or covered",
}


@dataclass(slots=True)
class _Lasting:
    """Whether something has lasted, and has not been over for long."""

    seconds: float
    since: float | None = None
    latest: float | None = None
    said: bool = False

    def now(self, t_mono: float, so: bool) -> bool:
        if so:
            self.since = t_mono if self.since is None else self.since
            self.latest = t_mono
            self.said |= t_mono - self.since >= self.seconds
        elif self.latest is None or t_mono - self.latest >= OVER_S:
            self.since, self.said = None, False
        return self.said


@dataclass(slots=True)
class LampWatch:
    """Watches the epochs go by.

    Attributes:
        faults: of lamps and survey, as of the latest epoch. stalled: blocks in which the bus stood still.
        odd: lamps with what is wrong with them, and when that was last so.
    """

    faults: frozenset[Fault] = frozenset()
    stalled: int = 0
    odd: dict[int, tuple[Fault, float]] = field(default_factory=dict)
    _t_epoch: float = float("-inf")
    _lamps: dict[tuple[int, Fault], _Lasting] = field(default_factory=dict)
    _dark: _Lasting = field(default_factory=lambda: _Lasting(LASTS_S))
    _twin: _Lasting = field(default_factory=lambda: _Lasting(TWIN_S))
    _wrong: _Lasting = field(default_factory=lambda: _Lasting(LASTS_S))

    def on_step(self, t_mono: float, lights: LightsResult | None, fresh: bool) -> None:
        """One step; ``fresh``: it took a block of samples in."""
        if lights is None or not fresh:
            return
        if lights.block & UNUSABLE:
            self.stalled += BlockFlag.STALLED in lights.block
            self._pass_on(t_mono)
            return
        received = [link for link in lights.links if link.state not in _UNHEARD]
        states = [link.state for link in received]
        said = {
            Fault.NO_LAMPS: self._dark.now(t_mono, not received),
            Fault.TWIN_LAMPS: self._twin.now(t_mono, _twins(received)),
            Fault.SURVEY_CONTRADICTED: self._wrong.now(t_mono, _contradicted(lights, states)),
        }
        self._look_at_each(t_mono, lights.links)
        self._sum_up({fault for fault, so in said.items() if so})

    def _pass_on(self, t_mono: float) -> None:
        """A block that tells nothing of any lamp; enough of them, and what was said of all lamps holds no longer."""
        watched = (Fault.NO_LAMPS, self._dark), (Fault.TWIN_LAMPS, self._twin), (Fault.SURVEY_CONTRADICTED, self._wrong)
        self._sum_up({fault for fault, lasting in watched if lasting.now(t_mono, so=False)})

    def _sum_up(self, present: set[Fault]) -> None:
        lamps = {fault for fault, _ in self.odd.values()} if Fault.SURVEY_CONTRADICTED not in present else set()
        self.faults = frozenset(present | lamps)

    def _look_at_each(self, t_mono: float, links: tuple[Link, ...]) -> None:
        """Find lamps that have been odd for long, and those that are well again; most links are neither."""
        lamps = self._lamps
        for link in links:
            if link.lamp_id is None:
                continue
            for state, fault in _ODD:
                so, lasting = link.state is state, lamps.get((link.lamp_id, fault)) if lamps else None
                if so and lasting is None:
                    lasting = lamps[link.lamp_id, fault] = _Lasting(LASTS_S)
                if lasting is not None and lasting.now(t_mono, so) and so:
                    self._find(link, fault, t_mono)
            if link.state is LinkState.ACCEPTED and link.lamp_id in self.odd:
                del self.odd[link.lamp_id]
                log.info("lamp %d (code %d) is received as it should be again", link.lamp_id, link.code)
        if self.odd:
            self.odd = {lamp: found for lamp, found in self.odd.items() if t_mono - found[1] < FORGOTTEN_S}
        if lamps:
            here = {link.lamp_id for link in links}
            self._lamps = {key: lasting for key, lasting in lamps.items() if key[0] in here}

    def _find(self, link: Link, fault: Fault, t_mono: float) -> None:
        assert link.lamp_id is not None
        if self.odd.get(link.lamp_id, (None,))[0] is not fault:
            log.warning("lamp %d (code %d) %s", link.lamp_id, link.code, _SAID[fault])
        self.odd[link.lamp_id] = (fault, t_mono)


def _twins(received: list[Link]) -> bool:
    """Whether two of the lamps received cannot be told apart: neither by their places, nor because one is known."""
    lamps = [link.lamp_id for link in received if link.lamp_id is not None]
    return any(link.state is LinkState.TWIN for link in received) or len(set(lamps)) < len(lamps)


def _contradicted(lights: LightsResult, states: list[LinkState]) -> bool:
    """Whether survey and light do not belong together: most lamps are odd, none is known, or the place was given up."""
    known = [state for state in states if state is not LinkState.UNSURVEYED]
    rejected = known.count(LinkState.REJECTED)
    strange = len(states) >= ENOUGH and not known
    return lights.fix is Fix.LOST or strange or (rejected >= ENOUGH and 2 * rejected > len(known))
