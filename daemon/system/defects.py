"""Limits tracebacks in the log: a defect that a client can repeat is logged whole once, then rarely and briefly.

A defect is a kind of exception that is raised at one place of the source, whatever its text.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Final

AGAIN_S: Final = 60.0
"""Least time between two lines of one defect, s."""
MOST: Final = 256
"""Largest number of defects that are distinguished; further ones count as one."""

Place = tuple[str, str, int]
"""Name of the exception's class, and file and line of the innermost frame."""


def place_of(error: BaseException) -> Place:
    """Where an exception was raised."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    if trace is None:
        return type(error).__name__, "", 0
    return type(error).__name__, trace.tb_frame.f_code.co_filename, trace.tb_lineno


class TracebackLimit(logging.Filter):
    """Filter of a log handler: of each defect one record with its traceback, then one without in :data:`AGAIN_S`.

    Args:
        clock: monotonic time, s.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._clock = clock
        self._seen: dict[Place, tuple[float, int]] = {}  # time of the last line, and records left out since

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is logged; a repeated one loses its traceback."""
        if not record.exc_info or (error := record.exc_info[1]) is None:
            return True
        place = place_of(error)
        if place not in self._seen and len(self._seen) >= MOST:
            place = ("", "", 0)
        now = self._clock()
        before = self._seen.get(place)
        if before is None:
            self._seen[place] = now, 0
            return True
        last, left_out = before
        if now - last < AGAIN_S:
            self._seen[place] = last, left_out + 1
            return False
        self._seen[place] = now, 0
        record.msg = f"{record.getMessage()}: {error!r} again, {left_out + 1} times since its last line"
        record.args, record.exc_info, record.exc_text = None, None, None
        return True


def log_once(log: logging.Logger, seen: set[Place], error: BaseException, text: str) -> None:
    """Log a defect with its traceback, where ``seen`` does not have it yet."""
    if (place := place_of(error)) not in seen and len(seen) < MOST:
        seen.add(place)
        log.error("%s", text, exc_info=error)
