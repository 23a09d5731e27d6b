"""When the played world lets the robot set off, and that all of what a scenario names can come until it ends."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.bench.world.judge import Pose, Read, middle_of
from tools.bench.world.scenario import ScenarioError, load
from tools.bench.world.stage import standing

BEGUN = 100.0
HERE: Pose = (1.0, 2.0, math.pi)


def heard(since: float, until: float, pose: Pose = HERE, state: str = "TRACKING") -> list[Read]:
    """A new pose ten times a second, each read twice; stamps are a twentieth of a second old."""
    reads = []
    for k in range(round(10.0 * (until - since))):
        t = since + 0.1 * k
        one = Read(t, state, 0, t - 0.05, pose, fresh=True)
        reads += [one, replace(one, t=t + 0.05, fresh=False)]
    return reads


def test_a_pose_that_stays_for_two_seconds_is_where_it_stands() -> None:
    assert standing(heard(100.1, 101.9), BEGUN) is None
    poses = standing(heard(100.1, 102.5), BEGUN)
    assert poses is not None
    assert set(poses) == {HERE}


def test_what_the_registers_hold_of_a_drive_before_is_not_where_it_stands() -> None:
    """It ended elsewhere, and stands there until the computer has taken in the first scan of this one."""
    left = Read(100.0, "TRACKING", 0, 99.8, (5.0, 5.0, 1.0), fresh=True)
    stale = [replace(left, t=100.0 + 0.05 * k, fresh=k == 0) for k in range(60)]
    assert standing(stale, BEGUN) is None
    assert standing([*stale, *heard(103.0, 103.9)], BEGUN) is None
    poses = standing([*stale, *heard(103.0, 105.5)], BEGUN)
    assert poses is not None
    assert set(poses) == {HERE}


def test_a_pose_that_jumps_to_its_place_or_is_looked_for_is_waited_for() -> None:
    before = heard(100.1, 103.0, (5.0, 5.0, 1.0))
    assert standing([*before, *heard(103.0, 104.5)], BEGUN) is None
    assert standing([*before, *heard(103.0, 105.5)], BEGUN) is not None
    looking = heard(103.0, 103.3, state="RELOCATING")
    assert standing([*before, *looking], BEGUN) is None
    assert standing([*before, Read(103.0, answered=False)], BEGUN) is None
    turning = [replace(one, pose=(1.0, 2.0, 0.1 * one.t)) for one in heard(100.1, 105.0)]
    assert standing(turning, BEGUN) is None


def test_the_middle_of_headings_about_half_a_turn_is_there() -> None:
    poses = np.array([(1.0, 0.0, math.pi - 0.01), (1.2, 0.0, -math.pi + 0.02), (9.0, 0.0, math.pi)])
    x, _, yaw = middle_of(poses).tolist()
    assert x == pytest.approx(1.2)
    assert math.cos(yaw) == pytest.approx(-1.0, abs=1e-6)


def scenario(tmp_path: Path, body: str) -> Path:
    file = tmp_path / "one.toml"
    file.write_text("[drive]\nseconds = 20.0\n" + body)
    return file


@pytest.mark.parametrize(
    ("body", "said"),
    [
        ('[[expect]]\nwhat = "fault"\nis = [9999]\nwithin = 4.0\n', "there is no fault 9999"),
        ('[[expect]]\nwhat = "error"\nat_most = -1.0\n', "at_most: -1 is negative"),
        ('[[expect]]\nwhat = "state"\nis = ["LOST"]\nfrom = 18.0\nwithin = 5.0\n', "at the latest"),
        ('[[expect]]\nwhat = "never"\nis = ["LOST"]\nuntil = 25.0\n', "at the latest"),
        (
            '[[fault]]\nwhat = "hangup"\nwhere = "lidar"\nwhen = 18.0\nfor = 4.0\n'
            '[[expect]]\nwhat = "never"\nis = ["LOST"]\n',
            "number 1: it lasts until 22 s",
        ),
    ],
)
def test_what_cannot_come_or_would_be_cut_short_is_refused(tmp_path: Path, body: str, said: str) -> None:
    with pytest.raises(ScenarioError, match=re.escape(said)):
        load(scenario(tmp_path, body))


def test_what_ends_with_the_drive_is_good(tmp_path: Path) -> None:
    body = '[[fault]]\nwhat = "hangup"\nwhere = "lidar"\nwhen = 16.0\nfor = 4.0\n'
    body += '[[expect]]\nwhat = "state"\nis = ["LOST"]\nfrom = 16.0\nwithin = 4.0\n'
    assert load(scenario(tmp_path, body)).expect[0].within == 4.0
