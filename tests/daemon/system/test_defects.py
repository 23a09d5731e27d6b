"""A defect that a client can repeat: its traceback once, then a line a minute, whatever its text."""

from __future__ import annotations

import io
import logging

from daemon.system.defects import AGAIN_S, MOST, Place, TracebackLimit, log_once

TRACE = "Traceback (most recent call last)"


class Bench:
    """A logger whose handler has the filter, and a clock."""

    def __init__(self) -> None:
        self.now = 0.0
        self.out = io.StringIO()
        handler = logging.StreamHandler(self.out)
        handler.addFilter(TracebackLimit(lambda: self.now))
        self.log = logging.Logger("bench")
        self.log.addHandler(handler)

    def fail(self, text: str, kind: type[Exception] = ValueError) -> None:
        try:
            raise kind(text)
        except kind:
            self.log.exception("request %s failed", text)


def test_a_repeated_defect_has_one_traceback() -> None:
    bench = Bench()
    for number in range(1000):
        bench.fail(f"number {number}")
        bench.now += 0.01
    assert bench.out.getvalue().count(TRACE) == 1
    assert bench.out.getvalue().count("\n") < 10
    bench.now += AGAIN_S
    bench.fail("last")
    assert bench.out.getvalue().splitlines()[-1] == (
        "request last failed: ValueError('last') again, 1000 times since its last line"
    )
    assert bench.out.getvalue().count(TRACE) == 1


def test_another_defect_has_its_own() -> None:
    bench = Bench()
    for _ in range(3):
        bench.fail("a")
        bench.fail("b", KeyError)
    assert bench.out.getvalue().count(TRACE) == 2


def test_lines_without_a_traceback_pass() -> None:
    bench = Bench()
    for number in range(100):
        bench.log.warning("line %d", number)
    assert bench.out.getvalue().count("line") == 100


def test_the_memory_of_defects_has_a_limit() -> None:
    bench = Bench()
    for number in range(4 * MOST):
        bench.fail("x", type(f"Error{number}", (Exception,), {}))
    assert bench.out.getvalue().count(TRACE) == MOST + 1


def test_a_part_logs_each_defect_once() -> None:
    bench, seen = Bench(), set[Place]()
    for number in range(100):
        try:
            int(f"x{number}")
        except ValueError as error:
            log_once(bench.log, seen, error, "cannot be answered")
    assert bench.out.getvalue().count(TRACE) == 1
    assert bench.out.getvalue().count("cannot be answered") == 1
