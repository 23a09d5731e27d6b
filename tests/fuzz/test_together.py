"""Damage at every door of the real processes at once; ``make fuzz-together`` does it for a minute."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

DOORS = ("commands", "fleet", "foxglove", "i2c server", "lidar", "metrics", "modbus line", "modbus tcp", "modbus udp")
DOORS += ("odometry", "replay", "stream", "subscriptions", "view")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(600)
def test_damage_at_every_door_at_once_breaks_nothing() -> None:
    words = [sys.executable, "-m", "tests.fuzz.together", "60"]
    done = subprocess.run(words, cwd=Path(__file__).parents[2], capture_output=True, text=True, check=False)
    found = json.loads(done.stdout[done.stdout.index("{") :])
    assert found["tracebacks"] == {}, found["first"]
    assert found["broken"] == []
    assert all(found["sent"][door] >= 10 for door in DOORS), found["sent"]
    assert max(found["lines"].values()) < 1000, "no door fills a log"
    assert sum(found["answers"].values()) > 50
    assert done.returncode == 0
