"""Tracebacks: one for an error, however often a client provokes it, whatever library reports it."""

import asyncio
import contextlib
import errno
import io
import logging
import sys
import threading

import pytest

from daemon.system import traceback_limit
from daemon.system.traceback_limit import AGAIN_S, EVERY_S, KINDS, TracebackLimit


class Log:
    """A logger with the limit, its clock and its text."""

    def __init__(self) -> None:
        self.now = 0.0
        self.stream = io.StringIO()
        handler = logging.StreamHandler(self.stream)
        handler.addFilter(TracebackLimit(lambda: self.now))
        self.logger = logging.Logger("some library")
        self.logger.addHandler(handler)

    def fail(self, error: Exception) -> None:
        try:
            raise error
        except Exception:
            self.logger.exception("a request failed")

    @property
    def text(self) -> str:
        return self.stream.getvalue()


def test_a_client_that_provokes_an_error_all_the_time_cannot_fill_the_log() -> None:
    log = Log()
    for request in range(10_000):
        log.now = 0.01 * request
        log.fail(ValueError(f"request {request} is damaged"))
    assert log.text.count("Traceback") == 1
    assert log.text.count("a request failed") <= 100.0 / EVERY_S + 1
    assert "a request failed: ValueError: request 1000 is damaged (999 more such lines were skipped" in log.text


def test_errors_of_other_kinds_and_places_have_their_own_traceback() -> None:
    log = Log()
    log.fail(ValueError("one"))
    log.fail(KeyError("another kind"))
    with contextlib.suppress(ZeroDivisionError):
        1 / 0  # noqa: B018  # it raises
    try:
        int("another place")
    except ValueError:
        log.logger.exception("a request failed")
    assert log.text.count("Traceback") == 3


def test_an_error_that_goes_on_has_its_traceback_again_after_an_hour() -> None:
    log = Log()
    for minute in range(130):
        log.now = 60.0 * minute
        log.fail(ValueError("still"))
    assert log.text.count("Traceback") == 1 + int(129 * 60.0 / AGAIN_S)
    assert log.text.count("a request failed") == 130


def test_what_the_computer_lacks_never_has_a_traceback() -> None:
    log = Log()
    log.fail(OSError(errno.EMFILE, "Too many open files"))
    assert log.text == "a request failed: OSError: [Errno 24] Too many open files\n"


def test_lines_without_an_error_pass() -> None:
    log = Log()
    for _ in range(100):
        log.logger.warning("a line")
    assert log.text.count("a line") == 100


def test_kinds_that_are_remembered_are_bounded() -> None:
    limit = TracebackLimit(lambda: 0.0)
    for number in range(3 * KINDS):
        error = ValueError(str(number))  # never raised: its place is its text
        record = logging.LogRecord("x", logging.ERROR, "x", 1, "x", (), (ValueError, error, None))
        assert limit.filter(record)
    assert len(limit._kinds) == KINDS


@pytest.fixture
def limited(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """The process's own log, with a fresh limit, and its text."""
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    monkeypatch.setattr(traceback_limit, "_LIMIT", TracebackLimit())
    monkeypatch.setattr(threading, "excepthook", threading.__excepthook__)
    monkeypatch.setattr(sys, "unraisablehook", sys.__unraisablehook__)
    monkeypatch.setattr(logging.root, "handlers", [handler])
    traceback_limit.limit_tracebacks(handler)
    return stream


def test_callbacks_of_the_loop_threads_and_finalisers_are_limited(limited: io.StringIO) -> None:
    class Broken:
        def __del__(self) -> None:
            raise RuntimeError("in a finaliser")

    def broken() -> None:
        raise RuntimeError("in a callback or a thread")

    async def scenario() -> None:
        loop = asyncio.get_running_loop()
        for _ in range(20):
            loop.call_soon(broken)
            Broken()
        await asyncio.sleep(0.01)

    asyncio.run(scenario())
    for _ in range(20):
        thread = threading.Thread(target=broken)
        thread.start()
        thread.join()
    text = limited.getvalue()
    assert text.count("Traceback") == 2, text
    assert "in a finaliser" in text
