"""The verdicts of the benches: bounds, regressions, latency, architectures, and maps of real logs."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tools.bench import crispness, maps
from tools.bench.crispness import LOGS, best_peer, load
from tools.bench.maps import thickness
from tools.bench.report.against import Compared, read, regressions
from tools.bench.report.page import page, write
from tools.bench.report.result import About, Figure, Result
from tools.bench.system import aarch64, latency
from tools.ci.figures import bounded

NOISE = Figure("noise", 10.0, "mm", "more")
GOOD = Result("boots", "Debian boots", True, 20.0, "up after 20 s", figures=(NOISE,))
ABOUT = About("bench-vm", "Virtual bench", {"version": "1", "configuration": "[lidar]\n<x>"})


def kept(tmp_path: Path, *results: Result) -> Path:
    write(tmp_path, list(results), ABOUT)
    return tmp_path / "results.json"


@pytest.mark.parametrize(
    ("worse", "value", "lost"),
    [
        ("more", 12.6, True),
        ("more", 12.4, False),
        ("less", 7.4, True),
        ("less", 99.0, False),
        ("", 99.0, False),
        ("more", math.nan, True),
        ("less", math.nan, True),
        ("", math.nan, False),
    ],
)
def test_a_figure_is_worse_in_its_own_direction(worse: str, value: float, lost: bool, tmp_path: Path) -> None:
    before = read(kept(tmp_path, GOOD), "bench-vm").results
    now = replace(GOOD, figures=(replace(NOISE, value=value, worse=worse),))
    assert bool(regressions([now], before)) is lost
    assert f"({10:.4g} then)" in page([now], ABOUT, Compared(), read(tmp_path, "bench-vm"))


def told(late_us: float, loaded_us: float, missed: int = 0, quiet: float = 0.12) -> dict[str, Any]:
    return {
        "late": {"quiet": [late_us] * 1000, "alone": [late_us] * 1000, "loaded": [loaded_us] * 1000},
        "cycle": {"quiet": [2900.0] * 1000, "alone": [3000.0] * 1000, "loaded": [3500.0] * 1000},
        "share": {"quiet": [quiet], "alone": [0.2], "loaded": [0.3]},
        "missed": missed, "scans": 2000, "solved": 9, "stalls": 0, "asked": 800, "answered": 799, "bare": [50.0] * 400,
    }  # fmt: skip


def test_rows_are_judged_with_real_time_rights_only() -> None:
    rows = latency.figures({"SCHED_FIFO": told(400.0, 700.0), "ordinary": told(4000.0, 90_000.0)})
    by_name = {row.name: row for row in rows}
    assert by_name["SCHED_FIFO: p99, loaded over alone"].value == pytest.approx(0.3)
    assert by_name["SCHED_FIFO: p99.9 of all cycles over the bare loop's"].value == pytest.approx(0.65)
    assert by_name["SCHED_FIFO: cycles, alone: late, p99"].value == pytest.approx(0.4)
    assert by_name["SCHED_FIFO: all threads, share of one core, quiet"].value == pytest.approx(12.0)
    assert by_name["ordinary: Modbus requests unanswered"].value == 1.0
    assert not any(row.ok is False for row in rows if row.name.startswith("SCHED_FIFO"))


def test_numbers_are_compared_by_kind() -> None:
    here = {"poses": [1.0, 2.0, 3.0], "codes": [5.0]}
    rows = aarch64.compared(here, {"poses": [1.0, 2.0, 3.0 + 1e-12], "codes": [5.0]})
    assert [row.ok for row in rows] == [True, True]
    rows = aarch64.compared(here, {"poses": [1.0, 2.0, 3.0], "codes": [6.0]})
    assert [row.ok for row in rows] == [True, False]


def wall(offsets: np.ndarray, normal_y: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Walls along x, 4 m long, at the given heights, seen a minute apart."""
    x = np.arange(0.0, 4.0, 0.01)
    points = np.concatenate([np.column_stack([x, np.full(len(x), y)]) for y in offsets])
    normals = np.tile((0.0, normal_y), (len(points), 1))
    return points, normals, np.repeat(60.0 * np.arange(len(offsets)), len(x))


def test_a_wall_laid_twice_is_as_thick_as_its_copies_are_apart() -> None:
    widths = thickness(*wall(np.array((0.0, 0.08))), samples=100)
    assert len(widths) == 100
    np.testing.assert_allclose(widths, 0.08, atol=1e-9)


@pytest.mark.slow
def test_walls_of_real_logs_are_thin(monkeypatch: pytest.MonkeyPatch, log_root: Path, tmp_path: Path) -> None:
    monkeypatch.setenv("LUMILOOP_DATA", str(log_root))
    monkeypatch.chdir(tmp_path)
    named = {figure.name: figure for figure in maps.run()}
    for log in ("intel", "aces"):
        assert named[f"{log}: thickness of walls, median"].value <= 100.0
        assert named[f"{log}: memory at most"].value <= 300.0
        assert (tmp_path / "out" / "bench" / f"map-{log}.png").stat().st_size < 300_000


@pytest.mark.slow
@pytest.mark.parametrize("name", LOGS)
def test_our_map_is_no_less_crisp_than_scan_to_scan(name: str, log_root: Path) -> None:
    drive = load(log_root / LOGS[name])
    assert 0.0 < crispness.crispness(drive, drive.ours) <= best_peer(drive)


def test_a_bound_is_judged() -> None:
    assert bounded("a", 0.02, "m", "<= 0.022", "x").ok
    assert not bounded("a", 0.03, "m", "<= 0.022", "x").ok
    assert bounded("speed", 101.0, "x", ">= 100", "x").ok
    assert not bounded("nan never passes", math.nan, "m", "<= 1", "x").ok
