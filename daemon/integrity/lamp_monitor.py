"""Lamp monitor: faults of lamps and survey from the links of every epoch; each is logged once, with the lamp's number.

A lamp is judged by how long its link stays in the same state. Its fault stays until the lamp is received normally,
because the robot may not pass it again for a while.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from typing import Final

from daemon.health.faults import Fault
from daemon.integrity.light_disturbance import LightDisturbances
from estimator import UNUSABLE, BlockFlag, Fix, LightsResult, Link, LinkState

log = logging.getLogger(__name__)

LASTS_S: Final = 10.0
"""Time in s for which a condition must last: a shorter one may be a passing obstruction."""
TWIN_S: Final = 3.0
"""The same for two lamps with one code: at a transition from one lamp to the next the condition occurs for a moment."""
OVER_S: Final = 3.0
"""Time in s without the condition after which it is over."""
FORGOTTEN_S: Final = 600.0
"""Time in s after which the fault of a lamp that is not in view any more is discarded."""
ENOUGH: Final = 3
"""Smallest number of links for a majority decision."""

_ODD: Final = ((LinkState.REJECTED, Fault.LAMP_MOVED), (LinkState.MISSING, Fault.LAMP_DEAD))
_UNHEARD: Final = (LinkState.FAINT, LinkState.MISSING)
_SAID: Final = {
    Fault.LAMP_MOVED: "differs from its survey: it was moved, exchanged, or its power has changed",
    Fault.LAMP_DEAD: "is not received where it is expected: defective, off, or covered",
}


@dataclass(slots=True)
class _Lasting:
    """Debounced condition: set after it has lasted ``seconds``, cleared after :data:`OVER_S` without it."""

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
    """Derives lamp and survey faults from the epochs.

    Attributes:
        faults: of lamps and survey, as of the latest epoch. stalled: blocks in which the bus stalled.
        odd: faults by lamp, with the time of the latest occurrence.
    """

    faults: frozenset[Fault] = frozenset()
    stalled: int = 0
    odd: dict[int, tuple[Fault, float]] = field(default_factory=dict)
    _disturbances: LightDisturbances = field(default_factory=LightDisturbances)
    _lamps: dict[tuple[int, Fault], _Lasting] = field(default_factory=dict)
    _dark: _Lasting = field(default_factory=lambda: _Lasting(LASTS_S))
    _twin: _Lasting = field(default_factory=lambda: _Lasting(TWIN_S))
    _wrong: _Lasting = field(default_factory=lambda: _Lasting(LASTS_S))

    def on_step(self, t_mono: float, lights: LightsResult | None, fresh: bool) -> None:
        """Update after one step; ``fresh``: the step consumed a block of samples."""
        if lights is None or not fresh:
            return
        self._disturbances.on_result(t_mono, lights)
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
        """Update after an unusable block: after enough of them, the faults that concern all lamps are cleared."""
        watched = (Fault.NO_LAMPS, self._dark), (Fault.TWIN_LAMPS, self._twin), (Fault.SURVEY_CONTRADICTED, self._wrong)
        self._sum_up({fault for fault, lasting in watched if lasting.now(t_mono, so=False)})

    def _sum_up(self, present: set[Fault]) -> None:
        lamps = {fault for fault, _ in self.odd.values()} if Fault.SURVEY_CONTRADICTED not in present else set()
        self.faults = frozenset(present | lamps)

    def _look_at_each(self, t_mono: float, links: tuple[Link, ...]) -> None:
        """Find lamps whose link has been faulty for long, and those that have recovered; most links are neither."""
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
                log.info("lamp %d (code %d) is received as expected again", link.lamp_id, link.code)
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
    """Whether two received links share a code and cannot be told apart: state TWIN, or one lamp ID twice."""
    lamps = [link.lamp_id for link in received if link.lamp_id is not None]
    return any(link.state is LinkState.TWIN for link in received) or len(set(lamps)) < len(lamps)


def _contradicted(lights: LightsResult, states: list[LinkState]) -> bool:
    """Whether light contradicts the survey: position lost, no code in the survey, or most links rejected."""
    known = [state for state in states if state is not LinkState.UNSURVEYED]
    rejected = known.count(LinkState.REJECTED)
    strange = len(states) >= ENOUGH and not known
    return lights.fix is Fix.LOST or strange or (rejected >= ENOUGH and 2 * rejected > len(known))
