"""Input monitor: scans and readings that are late, lost, or inconsistent with the other sensors.

The cycle updates its counters and facts for the vitals; they have no effect on the processing of the data.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

from daemon.health.reasons import Reason
from daemon.integrity.arrival_monitor import ODOMETRY_SILENT_S
from daemon.integrity.state_memory import Memory
from daemon.snapshot import State
from estimator import MatchResult
from estimator import Reason as MatchReason
from hal.lidar import RawScan
from hal.odometry import RawOdometry

LATE_PERIODS: Final = 2.5
"""Limit from a scan's first beam to its arrival, scan periods: the scan takes one, the line less than another."""
LATE_S: Final = 0.15
"""Limit of the age of an odometry reading at its arrival by its sender's clock, s."""
MISFIT_S: Final = 2.0
"""Time in s after which a lidar inconsistent with the map is reported, if the pose was available before."""
NOWHERE_S: Final = 5.0
"""The same after a start, when no pose in the whole map fits; in a room, the search takes 1.4 s of it."""
FITS_S: Final = 1.5
"""TRACKING has to last this long (s) to clear the fault: wrong ranges can also fit for a moment."""
QUIET_S: Final = 10.0
"""So does this time in s without a scan that does not fit: with one solution alone, TRACKING may not come for hours."""
DISAGREE_S: Final = 1.0
"""Odometry and lidar have to disagree for this long (s), as in the state machine."""
ODD: Final = (State.RELOCATING, State.AMBIGUOUS)


class Watch:
    """Monitors arrivals and the state machine's results.

    Attributes:
        late: scans that arrived late so far. repeated: that repeat an earlier one while the robot moves.
        readings, missed, old: odometry readings that arrived, were lost on the network, and arrived late.
        misfit: the lidar is inconsistent with the map. disagree: it is inconsistent with the odometry.
    """

    def __init__(self) -> None:
        self.late = self.repeated = self.readings = self.missed = self.old = 0
        self.misfit = self.disagree = False
        self._t_reading: float | None = None
        self._known = False
        self._odd_since: float | None = None
        self._odd_last = 0.0
        self._fits_since: float | None = None

    def on_scan(self, scan: RawScan, period: float) -> None:
        """Register a received scan."""
        self.late += scan.t_rx - scan.t_mono > LATE_PERIODS * period

    def on_match(self, match: MatchResult | None) -> None:
        """Register a scan that has been matched or refused."""
        self.repeated += match is not None and match.reason is MatchReason.REPEATED

    def on_odometry(self, reading: RawOdometry) -> None:
        """Register a received reading.

        Readings lost during a timeout are not counted; the timeout is reported instead.
        """
        if self._t_reading is not None and reading.t_rx - self._t_reading > ODOMETRY_SILENT_S:
            reading = replace(reading, missed=0)
        self.readings += 1
        self.missed += reading.missed
        self.old += reading.t_rx - reading.t_mono > LATE_S
        self._t_reading = reading.t_rx

    def on_verdict(self, t_mono: float, memory: Memory, scans: bool) -> None:
        """Update from the state machine's memory; ``scans``: they arrive and are compared with the map."""
        since = memory.disagree_since
        self.disagree = since is not None and t_mono - since >= DISAGREE_S
        self.misfit = self._at_odds(t_mono, memory, scans)

    def _at_odds(self, t_mono: float, memory: Memory, scans: bool) -> bool:
        """Whether the lidar has been inconsistent with the map for long enough to report it."""
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
    """Whether the latest scans do not fit. A pose can also be lost by its uncertainty alone, without such a scan."""
    lost = memory.state is State.LOST and memory.failed > 0
    return memory.reason is Reason.MATCH_FAILED or memory.state in ODD or lost
