"""Heartbeat: samples the vitals once a second, updates the faults, and feeds the watchdog only while cycles run."""

from __future__ import annotations

import asyncio
import logging
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Final

from daemon.health.assessment import STALLED_PERIODS, WINDOW_S, Vitals, assess, describe
from daemon.health.causes import CONSEQUENCES, cause_of, grouped
from daemon.health.faults import Fault, describe_consequence, describe_over
from daemon.health.journal_fields import of_fault
from daemon.health.present_faults import PresentFaults
from daemon.system.sd_notify import notify

log = logging.getLogger(__name__)

BEAT_S: Final = 1.0
STATISTICS_BEATS: Final = 300
"""Beats between two lines of statistics in the log; `systemctl status` shows the line of the latest beat."""
OVER_S: Final = 3.0
"""Time without the fault, s, after which it counts as over; an intermittent fault stays one fault."""


_OF_THE_LOOP: Final = frozenset([Fault.LOOP_STALLED, Fault.COMPUTER_SLOW])
"""Faults that a late beat shows for certain."""


@dataclass(slots=True)
class _Seen:
    """A logged fault: when first and last present (s), and the fault under which it was logged."""

    begun: float
    last: float
    cause: Fault


class Heartbeat:
    """Samples the vitals and derives the faults from them.

    Args:
        vitals: takes a sample, given the lateness of the loop in seconds.
        statistics: one line, for the service manager with every beat and for the log now and then.
        alive: whether all threads respond; otherwise the watchdog is not fed.
        present: receives the detected faults.
    """

    def __init__(
        self,
        vitals: Callable[[float], Vitals],
        statistics: Callable[[], str],
        alive: Callable[[], bool] = lambda: True,
        present: PresentFaults | None = None,
    ) -> None:
        self._present = present or PresentFaults()
        self._vitals = vitals
        self._statistics = statistics
        self._alive = alive
        self._samples: deque[Vitals] = deque()
        self._seen: dict[Fault, _Seen] = {}
        self._slow_until = -math.inf
        self._beats = 0
        self._failing = False
        self._late = False

    @property
    def faults(self) -> tuple[Fault, ...]:
        """Present faults, gravest first."""
        return self._present.faults

    async def run(self) -> None:
        """Beats until cancelled.

        A beat that fails does not feed the watchdog. It is logged once, and the next one is tried. A defect in the
        monitoring must not end a daemon that localises; a lasting one ends in a restart all the same.
        """
        loop = asyncio.get_running_loop()
        due = loop.time()
        while True:
            due = due + BEAT_S if loop.time() < due + BEAT_S else loop.time() + BEAT_S
            await asyncio.sleep(due - loop.time())
            try:
                self.beat(loop.time() - due)
            except Exception:
                if not self._failing:
                    log.exception("a periodic task has failed; the daemon logs this once until it works again")
                self._failing = True
            else:
                self._failing = False

    def beat(self, lateness: float) -> None:
        """Makes one beat; ``lateness``: delay of the loop at this beat, s."""
        now = self._vitals(lateness)
        if self._samples and self._samples[-1].cycles == 0:
            self._samples.clear()  # input lost while the estimator was being loaded is no fault
        self._samples.append(now)
        while len(self._samples) > 2 and now.t_mono - self._samples[1].t_mono >= WINDOW_S:
            self._samples.popleft()
        worst = max(sample.lateness for sample in self._samples)
        found = assess(replace(now, lateness=worst), self._samples[0])
        before, self._late = self._late, lateness > STALLED_PERIODS * now.period
        if self._late and not before:  # input that arrived meanwhile is not consumed yet: the next beat decides
            found = tuple(fault for fault in found if fault in _OF_THE_LOOP or fault in self.faults)
        self._tell(now, grouped((*found, *self._lasting(now, found))))
        if (len(self._samples) < 2 or now.cycles > self._samples[-2].cycles) and self._alive():
            notify("WATCHDOG=1")
        self._beats += 1
        statistics = self._statistics() if now.cycles else ""
        if statistics:
            notify(f"STATUS={statistics}")
        if statistics and self._beats % STATISTICS_BEATS == 0:
            log.info("%s", statistics)

    def _lasting(self, now: Vitals, found: tuple[Fault, ...]) -> tuple[Fault, ...]:
        """Returns COMPUTER_SLOW for a while after its evidence has ended, if something that follows from it is left.

        Rates are judged over a window, so that a consequence can end later than the evidence for its cause.
        """
        if Fault.COMPUTER_SLOW in found:
            self._slow_until = now.t_mono + WINDOW_S
        left = now.t_mono < self._slow_until and CONSEQUENCES[Fault.COMPUTER_SLOW].intersection(found)
        return (Fault.COMPUTER_SLOW,) if left else ()

    def _tell(self, now: Vitals, faults: tuple[Fault, ...]) -> None:
        """Logs each fault once when it appears, in its device's own words, and once when it is over.

        A consequence of another fault is logged below its cause, once as long as that lasts, and its end not at all.
        If it outlasts its cause, it is logged as a fault of its own.
        """
        for fault in faults:
            seen, cause = self._seen.get(fault), Fault(cause_of(fault, faults))
            if seen is None or (seen.cause is not Fault.NONE and cause is Fault.NONE):
                self._log(fault, cause, now)
                seen = self._seen[fault] = _Seen(now.t_mono, now.t_mono, cause)
            seen.last = now.t_mono
        for fault, seen in list(self._seen.items()):
            if now.t_mono - seen.last >= OVER_S and (seen.cause is Fault.NONE or seen.cause not in faults):
                del self._seen[fault]
                if seen.cause is Fault.NONE:
                    lasted = seen.last - seen.begun + BEAT_S
                    log.info("%s", describe_over(fault, lasted), extra=of_fault(fault, over=True))
        self._present.faults = faults

    def _log(self, fault: Fault, cause: Fault, now: Vitals) -> None:
        if cause is Fault.NONE:
            before = self._samples[0] if self._samples else now
            log.warning("%s", describe(fault, now, before), extra=of_fault(fault))
        else:
            log.info("%s", describe_consequence(fault, cause), extra=of_fault(fault))
