"""Log lines about damaged and unwritable cache files of compiled kernels, once per start."""

from __future__ import annotations

import logging

log = logging.getLogger(__name__)


class CacheComplaint:
    """Logs trouble with the cache files of one start; created before its kernels are loaded."""

    def __init__(self) -> None:
        from estimator import CACHE_REPORT

        self._report = CACHE_REPORT
        self._logged = False
        self._before = len(CACHE_REPORT.damaged)

    def log(self) -> None:
        """Log the first damaged file, once."""
        damaged = list(self._report.damaged.items())[self._before :]
        if damaged and not self._logged:
            self._logged = True
            log.warning("%s cannot be used: %s; its kernel, and any others like it, are compiled again", *damaged[0])

    def result(self) -> tuple[int, str]:
        """Number of damaged files, and the reason why kernels could not be stored; logs what has not been logged."""
        self.log()
        unwritten = self._report.unwritten
        if unwritten:
            log.warning("%s; compiled kernels cannot be stored, each start compiles them", unwritten)
        return len(self._report.damaged) - self._before, unwritten
