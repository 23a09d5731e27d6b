"""The judge of a played world: outages, errors of poses, and when a robot stands."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import pytest

from tests.tools.bench.world.test_world import way
from tools.bench.world.judge import Played, Pose, Read, judged
from tools.bench.world.scenario import BUILT_IN, Expectation, load
from tools.bench.world.stage import standing

LAP = load(BUILT_IN / "lap.toml")
POLL_S, TIMEOUT_S, PERIOD_S = 0.011, 0.5, 0.2
"""An answered read, one that nobody answers, and from one pose to the next."""
MUTE_S = (10.0, 19.0)
ANSWERS = Expectation("answers", at_least=0.99)
SHARE = Expectation("share", ("TRACKING",), at_least=0.9)
ERROR = Expectation("error", at_most=0.1, sigmas=3.0)


def lap(mute_s: tuple[float, float] = (0.0, 0.0), still_s: tuple[float, float] = (0.0, 0.0)) -> Played:
    """A drive without an error, polled as a robot computer is; meanwhile it is mute, or says one thing all the time."""
    reads: list[Read] = []
    t = last = 0.0
    while t < LAP.drive.seconds - TIMEOUT_S:
        mute = mute_s[0] <= t < mute_s[1]
        t += TIMEOUT_S if mute else POLL_S
        if mute:
            reads.append(Read(t, answered=False))
            continue
        made = last if still_s[0] <= t < still_s[1] else t // PERIOD_S * PERIOD_S
        pose = (0.0, -0.5 * made, 0.0)
        reads.append(Read(t, "TRACKING", 0, made, pose, 0.01, True, made != last))
        last = made
    return Played(LAP, reads, way, [(0.0, 0.0, 0.0)])


@pytest.mark.parametrize("expected", [ANSWERS, SHARE, ERROR])
def test_a_robot_computer_that_is_mute_for_a_part_of_the_drive_is_not_as_expected(expected: Expectation) -> None:
    """18 reads of 2000 that nobody answers are nine seconds of 32."""
    assert judged(expected, lap())[0]
    assert not judged(expected, lap(mute_s=MUTE_S))[0]


def test_an_error_is_judged_only_where_new_poses_come_all_along() -> None:
    """Mute, or answering from a cycle that stands still; how long is allowed may be said."""
    for part in (lap(mute_s=(10.0, 12.0)), lap(still_s=(10.0, 12.0))):
        holds, seen = judged(ERROR, part)
        assert not holds
        told = re.search(r"no new pose for (\d\.\d) s from (\d+\.\d) s on, where 1 s are allowed \(gap\)", seen.said)
        assert told, seen.said
        assert (float(told[1]), float(told[2])) == pytest.approx((2.1, 9.9), abs=0.2)
        assert judged(replace(ERROR, gap=2.5), part)[0]
        assert judged(replace(ERROR, until=10.0), part)[0]
        assert judged(replace(ERROR, from_=12.2), part)[0]
    assert judged(ERROR, lap(still_s=(10.0, 10.5)))[0], "some periods"


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
