"""The benchmark of latency: its C loop waits as long as it says, and its rows say what was measured."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from tools.bench.system import latency

needs_cc = pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler")


def told(late_us: float, loaded_us: float, missed: int = 0, quiet: float = 0.12) -> dict[str, Any]:
    return {
        "late": {"quiet": [late_us] * 1000, "alone": [late_us] * 1000, "loaded": [loaded_us] * 1000},
        "cycle": {"quiet": [2900.0] * 1000, "alone": [3000.0] * 1000, "loaded": [3500.0] * 1000},
        "share": {"quiet": [quiet], "alone": [0.2], "loaded": [0.3]},
        "missed": missed, "scans": 2000, "solved": 9, "stalls": 0, "asked": 800, "answered": 799, "bare": [50.0] * 400,
    }  # fmt: skip


@needs_cc
def test_the_loop_in_c_is_never_early_and_tells_every_turn(tmp_path: Path) -> None:
    late = latency.bare(latency.compiled(tmp_path), fifo=False, seconds=0.5)
    assert len(late) == 20
    assert min(late) >= 0.0


def test_rows_are_judged_with_real_time_rights_only() -> None:
    rows = latency.figures({"SCHED_FIFO": told(400.0, 700.0), "ordinary": told(4000.0, 90_000.0)})
    by_name = {row.name: row for row in rows}
    assert by_name["SCHED_FIFO: p99, loaded over alone"].value == pytest.approx(0.3)
    assert by_name["SCHED_FIFO: p99.9 of all cycles over the bare loop's"].value == pytest.approx(0.65)
    assert by_name["SCHED_FIFO: cycles, alone: late, p99"].value == pytest.approx(0.4)
    assert by_name["SCHED_FIFO: all threads, share of one core, quiet"].value == pytest.approx(12.0)
    assert by_name["ordinary: Modbus requests unanswered"].value == 1.0
    assert not any(row.ok is False for row in rows if row.name.startswith("SCHED_FIFO"))


def test_what_is_missed_shows() -> None:
    rows = latency.figures({"SCHED_FIFO": told(2000.0, 9000.0, missed=3, quiet=0.16)})
    missed = {row.name.removeprefix("SCHED_FIFO: ") for row in rows if row.ok is False}
    assert missed == {
        "cycles, alone: late, p99", "p99.9 of all cycles over the bare loop's",
        "p99, loaded over alone", "scans missed", "all threads, share of one core, quiet",
    }  # fmt: skip


def test_a_disturbance_of_one_pair_is_not_what_browsers_cost() -> None:
    found: dict[str, Any] = {what: {"alone": [100.0] * 1000, "loaded": [400.0] * 1000} for what in ("late", "cycle")}
    found |= {"pair": {stretch: [k // 200 for k in range(1000)] for stretch in ("alone", "loaded")}, "missed": 0}
    found["late"]["loaded"][200:400] = 200 * [9000.0]
    assert latency.by_pair(found, "late") == pytest.approx([0.3, 8.9, 0.3, 0.3, 0.3])
    rows = {row.name: row for row in latency.compared(found, "browsers", "x")}
    middle = rows["cycles begin late, p99, browsers over alone, of 5 pairs, median"]
    assert (middle.value, middle.ok) == (pytest.approx(0.3), True)
    assert rows["cycles begin late, p99, browsers over alone"].ok is False
