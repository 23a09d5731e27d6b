"""Limits on waiting for a disk: a network drive that is away, or a failing disk, may block a call for ever."""

from __future__ import annotations

import contextlib
import errno
import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import Final, TypeVar

from daemon.system.sd_notify import notify

log = logging.getLogger(__name__)

T = TypeVar("T")

REPORT_S: Final = 10.0
"""Interval in s between two lines about a wait."""
EXTEND_US: Final = 30_000_000
"""Extension in us of the service manager's start timeout, sent with each line..."""
EXTEND_S: Final = 900.0
"""...for this long (s). Then the service manager restarts the daemon."""


def nobody(result: object) -> None:
    """Default of ``late``: a late result is discarded."""


def within(seconds: float, work: Callable[[], T], late: Callable[[T], None] = nobody) -> T:
    """Result of ``work``, which runs in a thread; ``late`` receives the result if it comes after the limit (s).

    Raises:
        TimeoutError: it takes longer. The thread is left behind, and does not delay the end of the process.
    """
    results: list[T] = []
    errors: list[BaseException] = []
    lock, ended, abandoned = threading.Lock(), threading.Event(), threading.Event()

    def run() -> None:
        try:
            result = work()
        except BaseException as error:  # noqa: BLE001  raised again by the caller
            errors.append(error)
        else:
            with lock:
                results.append(result)
                if abandoned.is_set():
                    late(result)
        ended.set()

    try:
        threading.Thread(target=run, name="lumiloop-disk", daemon=True).start()
    except RuntimeError:  # no thread is available
        return work()
    if not ended.wait(seconds):
        with lock:
            if not results:
                abandoned.set()
                raise TimeoutError(errno.ETIMEDOUT, f"the disk does not answer within {seconds:.0f} s")
    if errors:
        raise errors[0]
    return results[0]


@contextlib.contextmanager
def reported(what: str) -> Iterator[None]:
    """Context that logs every few seconds how long it has been waiting for ``what``, and extends the start timeout."""
    begun, ended = time.monotonic(), threading.Event()

    def report() -> None:
        while not ended.wait(REPORT_S):
            waited = time.monotonic() - begun
            log.warning("waiting for %s for %.0f s: the disk does not answer", what, waited)
            if waited < EXTEND_S:
                notify(f"EXTEND_TIMEOUT_USEC={EXTEND_US}", f"STATUS=waiting for {what}")

    with contextlib.suppress(RuntimeError):  # no thread is available: nothing is reported
        threading.Thread(target=report, name="lumiloop-wait", daemon=True).start()
    try:
        yield
    finally:
        ended.set()
