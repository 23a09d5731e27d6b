"""What is left out is told at once, trials end nothing, and what comes again and again is told for longer."""

from __future__ import annotations

from daemon.integrity.laser_hysteresis import CALM, LONGEST, TAKEN_UP, LeftOut


def until_over(left: LeftOut) -> int:
    """Steps with the laser until it is no longer told to be left out."""
    steps = 1
    while left.on_step(left_out=False):
        steps += 1
    return steps


def test_told_at_once_and_over_after_a_few_steps_in_a_row() -> None:
    left = LeftOut()
    assert not left.on_step(left_out=False)
    assert left.on_step(left_out=True)
    for _ in range(3):
        assert all(left.on_step(left_out=False) for _ in range(TAKEN_UP - 1))
        assert left.on_step(left_out=True)
    assert until_over(left) == TAKEN_UP


def test_what_comes_again_and_again_is_told_for_longer_up_to_a_bound() -> None:
    left = LeftOut()
    needed = []
    for _ in range(12):
        left.on_step(left_out=True)
        needed.append(until_over(left))
    assert needed[:3] == [TAKEN_UP, 2 * TAKEN_UP, 4 * TAKEN_UP]
    assert needed[-1] == LONGEST


def test_after_a_calm_minute_or_an_order_it_is_the_first_time_again() -> None:
    left = LeftOut()
    for _ in range(5):
        left.on_step(left_out=True)
        until_over(left)
    for _ in range(CALM):
        left.on_step(left_out=False)
    left.on_step(left_out=True)
    assert until_over(left) == TAKEN_UP
    left.on_step(left_out=True)
    left.clear()
    assert not left.told
    left.on_step(left_out=True)
    assert until_over(left) == TAKEN_UP
