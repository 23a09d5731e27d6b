"""A part of the program logs each defect once, whatever its text."""

import logging

import pytest

from daemon.system.defects import Place, log_once


def test_a_part_logs_each_defect_once(caplog: pytest.LogCaptureFixture) -> None:
    log, seen = logging.getLogger("bench"), set[Place]()
    for number in range(100):
        try:
            int(f"x{number}")
        except ValueError as error:
            log_once(log, seen, error, "cannot be answered")
    assert [record.getMessage() for record in caplog.records] == ["cannot be answered"]
    assert caplog.records[0].exc_info
