"""A real drive, spoiled as robots in the field spoil theirs: while wheels are right, the place is never given up."""

from functools import cache

import numpy as np
import pytest

from daemon.snapshot import State
from tools.experiments.belief.replays import Replayed, Task, replayed

KINDS = (
    *("clean", "5 Hz", "3.3 Hz", "2 Hz", "gap of 5 s", "gap of 10 s", "swapped", "glitch", "two glitches", "spike"),
    *("poor second", "clock set back", "clock set on", "stamps repeat", "whole seconds", "odometry restarts"),
)


@cache
def run(kind: str) -> Replayed:
    return replayed(Task("exp2", kind))


@pytest.mark.parametrize("kind", KINDS)
def test_a_place_is_not_given_up_while_the_wheels_are_right(log_root: object, kind: str) -> None:
    told = run(kind)
    assert not told.refused
    assert told.guesses() == 0
    assert State.TRACKING in told.late


@pytest.mark.parametrize("kind", ["glitch", "two glitches", "swapped", "clock set back"])
def test_a_wrong_reading_costs_centimetres(log_root: object, kind: str) -> None:
    assert np.median(run(kind).off(run("clean"))[:, 0]) <= 0.3


def test_a_log_without_times_is_refused(log_root: object) -> None:
    assert "stamps cannot be used" in run("zero stamps").refused
