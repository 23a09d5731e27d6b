"""Heartbeat: samples the vitals once a second, updates the faults, and feeds the watchdog only while cycles run."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Final

from daemon.health.assessment import STALLED_PERIODS, WINDOW_S, Vitals, assess, describe
from daemon.health.faults import Fault, describe_over
from daemon.health.journal_fields import of_fault
from daemon.health.present_faults import PresentFaults
from daemon.system.sd_notify import notify

log = logging.getLogger(__name__)

BEAT_S: Final = 1.0
STATISTICS_BEATS: Final = 300
"""Beats between two lines of statistics in the log; `systemctl status` shows the line of the latest beat."""
OVER_S: Final = 3.0
"""Time without the fault, s, after which it counts as over; an intermittent fault stays one fault."""


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
        self._seen: dict[Fault, tuple[float, float]] = {}  # logged faults: when first and last present
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
                    log.exception("a heartbeat has failed; said once until they work again")
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
            found = tuple(fault for fault in found if fault is Fault.LOOP_STALLED or fault in self.faults)
        self._tell(now, found)
        if (len(self._samples) < 2 or now.cycles > self._samples[-2].cycles) and self._alive():
            notify("WATCHDOG=1")
        self._beats += 1
        statistics = self._statistics() if now.cycles else ""
        if statistics:
            notify(f"STATUS={statistics}")
        if statistics and self._beats % STATISTICS_BEATS == 0:
            log.info("%s", statistics)

    def _tell(self, now: Vitals, faults: tuple[Fault, ...]) -> None:
        """Logs each fault once when it appears, in its device's own words, and once when it is over."""
        for fault in faults:
            if fault not in self._seen:
                log.warning("%s", describe(fault, now), extra=of_fault(fault))
            begun, _ = self._seen.get(fault, (now.t_mono, 0.0))
            self._seen[fault] = begun, now.t_mono
        for fault, (begun, last) in list(self._seen.items()):
            if now.t_mono - last >= OVER_S:
                del self._seen[fault]
                log.info("%s", describe_over(fault, last - begun + BEAT_S), extra=of_fault(fault, over=True))
        self._present.faults = faults
