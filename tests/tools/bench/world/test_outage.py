"""A robot computer that is mute or stands still for a part of a drive: how much of the time that is, and what fails."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tests.tools.bench.world.test_world import way
from tools.bench.world.judge import Played, Read, judged, spans_of
from tools.bench.world.scenario import BUILT_IN, Expectation, load

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


@pytest.mark.parametrize("expected", [ANSWERS, SHARE])
def test_a_share_is_one_of_the_time(expected: Expectation) -> None:
    mute = lap(mute_s=MUTE_S)
    assert np.mean([one.answered for one in mute.reads]) > 0.99, "counted, nobody would have missed it"
    (figure,) = judged(expected, mute)[1].figures
    assert figure.value == pytest.approx(100.0 * (1.0 - 9.0 / 31.5), abs=1.5)
    (figure,) = judged(replace(expected, from_=14.0, until=24.0), mute)[1].figures
    assert figure.value == pytest.approx(50.0, abs=2.0), "what began before the window is of it from then on"


def test_reads_stand_for_all_of_a_window_and_no_more() -> None:
    mute = lap(mute_s=MUTE_S)
    assert spans_of(replace(ANSWERS, from_=9.7, until=18.7), mute).sum() == pytest.approx(9.0)
    assert spans_of(Expectation("state", ("LOST",), from_=12.1, within=0.3), mute).sum() == pytest.approx(0.3)


def test_the_strongest_lamp_is_right_for_a_share_of_the_time() -> None:
    mute = lap(mute_s=MUTE_S)
    reads = [replace(one, lamps=((7, 1e-6),) if one.answered else ()) for one in mute.reads]
    lit = replace(mute, reads=reads, lamps=frozenset({7}), strongest=lambda t: 7)
    assert not judged(Expectation("lamps", at_least=0.9), lit)[0]
    assert judged(Expectation("lamps", at_least=0.9, until=9.0), lit)[0]


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


def test_a_drive_is_watched_to_its_end() -> None:
    assert not judged(ERROR, lap(still_s=(29.0, 32.0)))[0]
    early = replace(lap(), reads=[one for one in lap().reads if one.t < 20.0])
    assert "from 19.8 s on" in judged(ERROR, early)[1].said


def test_a_lidar_that_fails_where_there_are_no_wheels_leaves_a_gap_that_a_file_allows() -> None:
    """In virtual time it is 1.8 s of `garbage`; who is mute for longer than the fault lasts is found all the same."""
    (expected,) = [one for one in load(BUILT_IN / "garbage.toml").expect if one.what == "error"]
    assert judged(expected, lap(still_s=(11.3, 13.1)))[0]
    assert not judged(expected, lap(mute_s=MUTE_S))[0]


def test_how_long_no_pose_may_come_is_a_key_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('[[expect]]\nwhat = "error"\nat_most = 0.1\ngap = 3\n')
    (expected,) = load(file).expect
    assert expected.gap == 3.0
    assert str(expected) == "error at most 0.1, gap s 3"
