"""The virtual bench: its judgement of daemons and drives, and the package in an emulated computer."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tools.bench.report.result import Seen
from tools.bench.vm import bench, common, image, places, trying_system
from tools.bench.vm.bench import Bench, Ears, Heard
from tools.bench.vm.guests import tried
from tools.bench.vm.scenarios import SCENARIOS

ROOT = Path(__file__).parents[4]


@pytest.mark.system
@pytest.mark.timeout(600)
def test_six_scenarios_where_there_is_an_image_of_these_sources(tmp_path: Path) -> None:
    """Boots, is found, starts, is restricted, keeps real time; making the image takes too long here."""
    made = image.Image(image.cache() / f"image-{image.image_key()}")
    if reason := places.missing(build=False) or (made.lacks() and "no image of these sources: make bench-vm makes it"):
        pytest.skip(reason)
    assert [one.__name__ for one in SCENARIOS].index("takes_real_time") == 5
    command = [sys.executable, "-m", "tools.bench.vm", "takes_real_time", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    assert "6 of 6 passed" in done.stdout


@pytest.mark.system
@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(3600)
def test_the_package_in_an_emulated_computer(tmp_path: Path) -> None:
    if reason := places.missing():
        pytest.skip(reason)
    command = [sys.executable, "-m", "tools.bench.vm", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


class Lived:
    """A bench whose daemon has these lives, one after the other; the last one stays."""

    def __init__(self, *lives: tuple[int, int], life: tuple[int, int] = (0, 0)) -> None:
        self.left, self.life = list(lives), life

    def lives(self) -> tuple[int, int]:
        return self.left.pop(0) if len(self.left) > 1 else self.left[0]

    def log(self, lines: int) -> str:
        return "its log"


def passes(bench: bench.Bench) -> str:
    """It passes."""
    return "seen"


@pytest.mark.parametrize(
    ("daemon", "before", "after", "as_wanted"),
    [
        ("same", (7, 0), (7, 0), True),
        ("same", (7, 0), (8, 1), False),
        ("same", (7, 0), (7, 1), False),
        ("same", (7, 0), (0, 0), False),
        ("same", (0, 0), (0, 0), True),
        ("anew", (0, 0), (7, 0), True),
        ("anew", (7, 0), (7, 0), True),
        ("anew", (0, 0), (8, 1), False),
        ("anew", (0, 0), (0, 0), False),
        ("restarted", (7, 0), (8, 1), True),
        ("restarted", (7, 0), (7, 0), False),
        ("restarted", (7, 0), (9, 2), False),
        ("gone", (7, 0), (0, 0), True),
        ("gone", (7, 0), (7, 0), False),
    ],
)
def test_a_daemon_that_dies_unnoticed_fails_the_scenario(
    daemon: common.Daemon,
    before: tuple[int, int],
    after: tuple[int, int],
    as_wanted: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(common.AFTER, passes, daemon)
    lived = Lived(after, life=before)
    result = tried(passes, lived)  # type: ignore[arg-type]  # all that is looked at
    assert result.passed is as_wanted
    assert as_wanted or result.said.startswith("the daemon has died unnoticed: process ")
    assert lived.life == after


def inside(run: Any = None, waited: float = 0.0) -> Bench:
    """One that answers commands by ``run``, and has waited for a processor so long whenever it is asked again."""
    told = iter([10.0, 10.0 + waited])
    machine = SimpleNamespace(run=run, waited_s=lambda: next(told), broken_off=threading.Event())
    bench = Bench.__new__(Bench)
    bench.machine, bench.ears, bench.memory = machine, Ears(), {}  # type: ignore[assignment]  # all that is asked
    return bench


def poses(count: int) -> list[Heard]:
    return [Heard(0.2 * k + 0.04, 0.2 * k, 3, (0.1 * k, 0.0, 0.0), 0.01) for k in range(count)]


def driven() -> Bench:
    """One that has heard the truth."""
    bench = inside()
    bench.ears.truth.extend((0.05 * k, (0.025 * k, 0.0, 0.0)) for k in range(2000))
    return bench


@pytest.mark.parametrize(("degraded", "off", "right"), [(4, 0.0, True), (8, 0.0, False), (0, 0.2, False)])
def test_a_drive_is_tracking_and_right_and_is_shown_where_it_is_not(
    degraded: int, off: float, right: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    bench = driven()
    bench.folder = tmp_path
    heard = [replace(one, pose=(0.1 * k, off, 0.0), state=3 if k >= degraded else 4) for k, one in enumerate(poses(51))]
    bench.start = (0.0, 0.0, 0.0)
    for name, made in (
        ("drive", lambda: None), ("until", lambda *_: 0.0), ("collect", lambda seconds: heard),
        ("placed", lambda *_: 0.0),
    ):  # fmt: skip
        monkeypatch.setattr(bench, name, made)
    if right:
        assert isinstance(trying_system.drives(bench), Seen)
        kept = json.loads((tmp_path / "drive").read_text())
        assert kept["poses"][3][1:3] == [pytest.approx(0.6), [pytest.approx(0.3), 0.0, 0.0]]
        assert kept["truth"][12] == [pytest.approx(0.6), [pytest.approx(0.3), 0.0, 0.0]]
        return
    with pytest.raises(common.Unmet, match=r"TRACKING for 84 % of 51 poses|0\.200 m from the truth") as unmet:
        trying_system.drives(bench)
    assert [plot.title for plot in unmet.value.seen.plots] == ["trajectory", "age of a pose that comes"]
