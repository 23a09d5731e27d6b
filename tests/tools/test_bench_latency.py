"""The benchmark of latency: its C loop waits as long as it says, and its rows say what was measured."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest

from tools.bench import latency

needs_cc = pytest.mark.skipif(shutil.which("cc") is None and shutil.which("gcc") is None, reason="no C compiler")


def told(late_us: float, loaded_us: float, missed: int = 0) -> dict[str, Any]:
    return {
        "late": {"alone": [late_us] * 1000, "loaded": [loaded_us] * 1000},
        "cycle": {"alone": [3000.0] * 1000, "loaded": [3500.0] * 1000},
        "share": {"alone": [0.12], "loaded": [0.3]},
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
    assert by_name["SCHED_FIFO: all threads, share of one core, alone"].value == pytest.approx(12.0)
    assert by_name["ordinary: Modbus requests unanswered"].value == 1.0
    assert not any(row.ok is False for row in rows if row.name.startswith("SCHED_FIFO"))


def test_what_is_missed_shows() -> None:
    rows = latency.figures({"SCHED_FIFO": told(2000.0, 9000.0, missed=3)})
    missed = {row.name.removeprefix("SCHED_FIFO: ") for row in rows if row.ok is False}
    assert missed == {
        "cycles, alone: late, p99", "p99.9 of all cycles over the bare loop's",
        "p99, loaded over alone", "scans missed",
    }  # fmt: skip
