"""Kills at random moments of writing the pose: the file always holds a whole one, and never an older one than seen."""

import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

from daemon.maps.last_pose import FILE, read

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

ROOT = Path(__file__).parents[3]
KILLS = 100
WRITER = """
import sys, itertools
from pathlib import Path
from daemon.maps.last_pose import LastPose, Remembered
kept = LastPose(Path(sys.argv[1]))
for k in itertools.count():
    kept._put(Remembered(7, (float(kept._number + 1), 0.0, 0.0), 1.7e9), 0.0)
    kept._turn()
    if k == 0:
        print(flush=True)
"""


def test_a_kill_in_mid_write_leaves_a_whole_pose(tmp_path: Path) -> None:
    chance, before = random.Random(3), 0
    for _ in range(KILLS):
        with subprocess.Popen(
            [sys.executable, "-c", WRITER, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE
        ) as writer:
            assert writer.stdout is not None
            writer.stdout.readline()
            time.sleep(chance.uniform(0.0, 0.02))
            writer.kill()
        told = read(tmp_path / FILE)
        assert told is not None
        assert told.number > before
        assert told.pose == (float(told.number), 0.0, 0.0)
        before = told.number
