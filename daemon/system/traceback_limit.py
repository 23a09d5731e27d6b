"""Limit of tracebacks in a log: the first error of one kind and place has one, the repetitions are lines at a low rate.

A client that can provoke an error must not be able to fill the log, whatever library reports the error.
"""

from __future__ import annotations

import errno
import logging
import sys
import threading
import time
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Final

AGAIN_S: Final = 3600.0
"""Time after which an error that has gone on repeating is logged with its traceback again, s."""
EVERY_S: Final = 10.0
"""Minimum interval between two lines on one error, s; those between are counted."""
KINDS: Final = 256
"""Number of kinds of error that are remembered, the latest ones."""
EXHAUSTED: Final = frozenset([errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOSPC])
"""Errors of the operating system that no line of the program explains: they never have a traceback."""

Place = tuple[str, str, int]
"""Type of the error, and the file and the line that raised it."""


@dataclass(slots=True)
class _Kind:
    """One kind of error: when it last had a traceback and a line (s), and the lines left out since."""

    traced: float
    said: float
    left_out: int = 0


class TracebackLimit(logging.Filter):
    """Filter of a log handler.

    Args:
        now: monotonic time, s.
    """

    def __init__(self, now: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self._now = now
        self._kinds: OrderedDict[Place, _Kind] = OrderedDict()

    def filter(self, record: logging.LogRecord) -> bool:
        """Return False for a line that is left out; removes a traceback that was logged before."""
        error = record.exc_info[1] if isinstance(record.exc_info, tuple) else None
        if error is None:
            return True
        now, place = self._now(), _place(error)
        kind = self._kinds.get(place)
        exhausted = isinstance(error, OSError) and error.errno in EXHAUSTED
        if kind is None:
            self._kinds[place] = _Kind(now, now)
            if len(self._kinds) > KINDS:
                self._kinds.popitem(last=False)
            if exhausted:
                _shorten(record, error, 0)
            return True
        self._kinds.move_to_end(place)
        if now - kind.said < EVERY_S:
            kind.left_out += 1
            return False
        left_out, kind.left_out, kind.said = kind.left_out, 0, now
        if exhausted or now - kind.traced < AGAIN_S:
            _shorten(record, error, left_out)
        else:
            kind.traced = now
        return True


def _place(error: BaseException) -> Place:
    trace, name = error.__traceback__, type(error).__name__
    if trace is None:
        return name, str(error), 0
    while trace.tb_next is not None:
        trace = trace.tb_next
    return name, trace.tb_frame.f_code.co_filename, trace.tb_lineno


def _shorten(record: logging.LogRecord, error: BaseException, left_out: int) -> None:
    """Replace the traceback by the error in words."""
    more = f" ({left_out} more such lines were skipped before it)" if left_out else ""
    first = record.getMessage().partition("\n")[0]
    record.msg, record.args = "%s: %s: %s%s", (first, type(error).__name__, error, more)
    record.exc_info = record.exc_text = None


_LIMIT: Final = TracebackLimit()
"""That of this process."""


def limit_tracebacks(handler: logging.Handler | None = logging.lastResort) -> None:
    """Limit the tracebacks of a log handler of this process, and of errors in threads and finalisers. Idempotent.

    Default: the handler of a process that sets none.
    """
    if handler is not None:
        handler.addFilter(_LIMIT)
    if threading.excepthook is threading.__excepthook__:
        threading.excepthook = _in_thread
    if sys.unraisablehook is sys.__unraisablehook__:
        sys.unraisablehook = _in_finaliser


def _in_thread(args: threading.ExceptHookArgs) -> None:
    if args.exc_type is SystemExit:
        return
    name = "a thread" if args.thread is None else f"thread {args.thread.name}"
    _report(f"{name} has failed", args.exc_type, args.exc_value, args.exc_traceback)


def _in_finaliser(args: Any) -> None:  # sys.UnraisableHookArgs exists for the type checker alone
    _report(args.err_msg or "an error outside a call", args.exc_type, args.exc_value, args.exc_traceback)


def _report(what: str, kind: type[BaseException], error: BaseException | None, trace: TracebackType | None) -> None:
    error = kind() if error is None else error
    logging.getLogger(__name__).error("%s", what, exc_info=(kind, error.with_traceback(trace), trace))
