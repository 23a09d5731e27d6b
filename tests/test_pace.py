"""A failed test of real time is skipped on a crowded machine, with the measure, and nowhere else."""

import time
from pathlib import Path

import pytest

from tests import pace
from tests.pace import Pace, max_mean, runnable


@pytest.mark.parametrize(
    ("realtime", "passes", "crowded", "outcome"),
    [
        (True, False, "too busy: 9.0", "skipped"),
        (True, False, "", "failed"),
        (True, True, "too busy: 9.0", "passed"),
        (False, False, "too busy: 9.0", "failed"),
    ],
)
def test_a_failure_in_real_time_is_judged_by_the_pace(
    realtime: bool, passes: bool, crowded: str, outcome: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert judged(realtime, passes, crowded, monkeypatch) == outcome


def judged(realtime: bool, passes: bool, crowded: str, monkeypatch: pytest.MonkeyPatch) -> str:
    """Outcome of a report after the judgement."""
    report = pytest.TestReport("x", ("x", 1, "x"), {}, "passed" if passes else "failed", None, "call")
    measured = Pace(processors=1)
    monkeypatch.setattr(measured, "crowded", lambda: crowded)
    measured.stop()
    pace.judge(report, measured if realtime else None)
    if report.outcome == "skipped":
        assert isinstance(report.longrepr, tuple)
        assert crowded in report.longrepr[2]
    return report.outcome


def test_runnable_threads_are_those_of_the_computer(tmp_path: Path) -> None:
    number = runnable()
    assert number is None or number >= 1
    made = tmp_path / "loadavg"
    made.write_text("0.50 0.40 0.30 7/123 4567\n")
    assert runnable(made) == 7
    made.write_text("nothing of the kind\n")
    assert runnable(made) is None
    assert runnable(tmp_path / "none") is None


@pytest.mark.parametrize(("threads", "crowded"), [(2, False), (5, False), (6, True), (40, True)])
def test_a_third_of_a_processor_is_enough(tmp_path: Path, threads: int, crowded: bool) -> None:
    made = tmp_path / "loadavg"
    made.write_text(f"0.50 0.40 0.30 {threads}/123 4567\n")
    measured = Pace(processors=2, source=made)
    time.sleep(5 * pace.EVERY_S)
    measured.stop()
    assert bool(measured.crowded()) == crowded
    if crowded:
        assert f"{threads / 2:.1f} runnable threads" in measured.crowded()


def test_the_worst_second_counts() -> None:
    assert max_mean([], 20) == 0.0
    assert max_mean([3], 20) == 3.0
    assert max_mean([1] * 100 + [9] * 20 + [1] * 100, 20) == 9.0
    assert max_mean([1, 9, 1], 2) == 5.0
