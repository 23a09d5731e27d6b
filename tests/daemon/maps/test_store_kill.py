"""A process is killed while it saves its map: what is on the disk then is the old map or the new one."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]


def kill(folder: Path, kills: int, seed: int) -> dict[str, int]:
    command = [sys.executable, "-m", "tests.daemon.maps.killed_saves", str(folder), str(kills), str(seed)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=1700.0, check=False)
    assert done.returncode == 0, done.stderr
    found: dict[str, int] = json.loads(done.stdout)
    return found


@pytest.mark.system
def test_100_kills_leave_the_old_map_or_the_new_one(tmp_path: Path) -> None:
    found = kill(tmp_path, 100, 1)
    assert found["old"] + found["new"] == 100
    assert found["half_written"] > 0, "some were killed in the middle of a file"
    assert found["saves"] > 5
    assert found["broken"] == 0


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_1000_kills_leave_the_old_map_or_the_new_one(tmp_path: Path) -> None:
    found = kill(tmp_path, 1000, 2)
    assert found["old"] + found["new"] == 1000
    assert found["half_written"] > 20
    assert found["new"] > 10, "some were killed between the file's being there and its being told"
    assert found["broken"] == 0
