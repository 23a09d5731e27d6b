"""docs/faults.md says what was measured, of every cell, and the measurements say what the table of cells allows."""

from __future__ import annotations

import re
from typing import Final

from daemon.health.faults import Fault
from tests.faults.matrix import cells
from tests.faults.report import PAGE, kept, page

OF_DEFECTS: Final = {Fault.WORKER_FAILED, Fault.FLIGHT_RECORDER_FAILED}
"""What no cable, process or disk brings about alone."""


def test_the_page_is_what_was_measured() -> None:
    assert PAGE.read_text() == page(kept()), "python -m tests.faults --render"


def test_every_fault_is_in_the_index_by_its_number() -> None:
    part = PAGE.read_text().partition("## By number")[2]
    numbers = [int(number) for number in re.findall(r"^\| (\d+) \|", part, re.MULTILINE)]
    assert numbers == sorted(int(fault) for fault in Fault if fault)
    assert "| 101 | no lidar is found | lidar off" in part


def test_every_fault_of_the_computer_has_a_row_that_names_its_test() -> None:
    part = PAGE.read_text().partition("## The computer")[2].partition("\n## ")[0]
    rows = [line.split(" | ") for line in part.splitlines() if line.startswith("| ")][2:]
    told = {int(code) for row in rows for code in re.findall(r"\b[1-4]\d\d\b", row[1])}
    assert {int(fault) for fault in Fault if fault > Fault.LOOP_STALLED} - told == OF_DEFECTS
    for row in rows:
        tests = re.findall(r"`(tests/\S+)`", row[-1])
        assert tests, row
        assert all((PAGE.parents[1] / path).is_file() for path in tests), row


def test_every_cell_was_measured_and_survived_unless_it_is_a_known_defect() -> None:
    results = kept()
    for cell in cells():
        assert bool(results[cell.name]["objections"]) == bool(cell.defect), cell.name


def test_what_was_measured_is_within_what_the_cell_allows() -> None:
    results = kept()
    for cell in cells():
        if cell.defect:
            continue
        one = results[cell.name]
        assert {str(code) for code in cell.codes} <= set(one["codes"]), cell.name
        assert set(one["codes"]) <= {str(code) for code in (*cell.codes, *cell.also)}, cell.name
        assert one["back"] is not None, cell.name
        assert one["back"] <= cell.back + 0.05, cell.name
        assert one["error_cm"] <= 10.0, cell.name
        assert one["sigmas"] <= 3.0, cell.name
