"""The virtual bench: its judgement of daemons and drives, and the package in an emulated computer."""

import subprocess
import sys
from pathlib import Path

import pytest

from tools.bench.vm import bench, common, image, places
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
