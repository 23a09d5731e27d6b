"""The verdicts of the benches: bounds, regressions, latency, architectures, and maps of real logs."""

import math
from dataclasses import replace
from pathlib import Path

import pytest

from tools.bench import crispness, maps
from tools.bench.crispness import LOGS, best_peer, load
from tools.bench.report.against import Compared, read, regressions
from tools.bench.report.page import page, write
from tools.bench.report.result import About, Figure, Result
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
