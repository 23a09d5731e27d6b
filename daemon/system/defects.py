"""Logs a defect that a client can repeat once for each part of the program (`traceback_limit` limits all others).

A defect is a kind of exception that is raised at one place of the source, whatever its text.
"""

from __future__ import annotations

import logging
from typing import Final

MOST: Final = 256
"""Largest number of defects that a part logs."""

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


def log_once(log: logging.Logger, seen: set[Place], error: BaseException, text: str) -> None:
    """Log a defect with its traceback, where ``seen`` does not have it yet."""
    if (place := place_of(error)) not in seen and len(seen) < MOST:
        seen.add(place)
        log.error("%s", text, exc_info=error)
