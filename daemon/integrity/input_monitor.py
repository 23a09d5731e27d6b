"""Input monitor: scans and readings that are late, lost, or inconsistent with the other sensors.

Counters and facts for the vitals, fed by the cycle; nothing here changes what is done with the data.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from daemon.health.reasons import Reason
from daemon.integrity.arrival_monitor import ODOMETRY_SILENT_S
from daemon.integrity.state_memory import Memory
from daemon.snapshot import State
from hal.lidar import RawScan
from hal.odometry import RawOdometry

LATE_PERIODS: Final = 2.5
"""Scan periods from a scan's first beam to its arrival: a revolution takes one, the line less than another."""
LATE_S: Final = 0.15
"""Age of an odometry reading at its arrival, as the clock of its sender tells."""
MISFIT_S: Final = 2.0
"""A laser that is at odds with the map for this long is told, once the place had been known."""
NOWHERE_S: Final = 5.0
"""The same after a start, where no place in the whole map fits; in a room a search takes 1.4 s of it."""
FITS_S: Final = 1.5
"""TRACKING has to last for this long to take it back: wrong ranges, too, now and then fit for a moment."""
QUIET_S: Final = 10.0
"""As long without a scan that does not fit takes it back, too: without a witness TRACKING may not come for hours."""
DISAGREE_S: Final = 1.0
"""Wheels and laser have to disagree for this long, as in the state machine."""
ODD: Final = (State.RELOCATING, State.AMBIGUOUS)


class Watch:
    """Watches arrivals and verdicts.

    Attributes:
        late: scans that arrived late so far. readings, missed, old: odometry readings that came, that were lost on
            their way, and that came late.
        misfit: the laser is at odds with the map. disagree: with the wheels.
    """

    def __init__(self) -> None:
        self.late = self.readings = self.missed = self.old = 0
        self.misfit = self.disagree = False
        self._t_reading: float | None = None
        self._known = False
        self._odd_since: float | None = None
        self._odd_last = 0.0
        self._fits_since: float | None = None

    def on_scan(self, scan: RawScan, period: float) -> None:
        """A scan has been taken."""
        self.late += scan.t_rx - scan.t_mono > LATE_PERIODS * period

    def on_odometry(self, reading: RawOdometry) -> None:
        """A reading has been taken; what was lost while none came at all is told as silence."""
        if self._t_reading is not None and reading.t_rx - self._t_reading > ODOMETRY_SILENT_S:
            reading = replace(reading, missed=0)
        self.readings += 1
        self.missed += reading.missed
        self.old += reading.t_rx - reading.t_mono > LATE_S
        self._t_reading = reading.t_rx

    def on_verdict(self, t_mono: float, memory: Memory, scans: bool) -> None:
        """A cycle has judged; ``scans``: they arrive and are compared with the map."""
        since = memory.disagree_since
        self.disagree = since is not None and t_mono - since >= DISAGREE_S
        self.misfit = self._at_odds(t_mono, memory, scans)

    def _at_odds(self, t_mono: float, memory: Memory, scans: bool) -> bool:
        """Whether the laser has been at odds with the map for long enough to be told."""
        fits = memory.state is State.TRACKING
        self._known |= fits
        self._fits_since = (t_mono if self._fits_since is None else self._fits_since) if fits else None
        nowhere = memory.state is State.RELOCATING and memory.reason is Reason.SEARCHING
        odd = _odd(memory) if self._known else nowhere
        settled = self._fits_since is not None and t_mono - self._fits_since >= FITS_S
        if not scans or settled or not (self._known or nowhere):
            self._odd_since = None
        elif odd:
            self._odd_since = t_mono if self._odd_since is None else self._odd_since
            self._odd_last = t_mono
        elif t_mono - self._odd_last >= QUIET_S:
            self._odd_since = None
        enough = MISFIT_S if self._known else NOWHERE_S
        return self._odd_since is not None and t_mono - self._odd_since >= enough


def _odd(memory: Memory) -> bool:
    """Whether the latest scans do not fit; a pose that is only too uncertain is lost without a scan at odds with it."""
    lost = memory.state is State.LOST and memory.failed > 0
    return memory.reason is Reason.MATCH_FAILED or memory.state in ODD or lost
