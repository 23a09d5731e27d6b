"""Lamps and survey under watch: what lasts is said once with the lamp's number, what passes is not."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from daemon.health.faults import Fault
from daemon.integrity.lamp_monitor import FORGOTTEN_S, LASTS_S, LampWatch
from estimator.cdma.epoch import BlockFlag
from estimator.result import Fix, LightsResult, Link, LinkState

EPOCH_S = 0.05
ACCEPTED, REJECTED, MISSING = LinkState.ACCEPTED, LinkState.REJECTED, LinkState.MISSING
TWIN, FAINT, UNSURVEYED = LinkState.TWIN, LinkState.FAINT, LinkState.UNSURVEYED


def lights(states: Sequence[LinkState], fix: Fix = Fix.GOOD, block: BlockFlag = BlockFlag.NONE) -> LightsResult:
    links = tuple(
        Link(10 + n, None if state in (TWIN, UNSURVEYED) else 100 + n, state, 1e-6 / (n + 1))
        for n, state in enumerate(states)
    )
    zero = np.zeros((3, 3))
    return LightsResult(0.0, fix, np.zeros(3), zero, links, frozenset(), zero, np.zeros(3), block=block)


class Watch:
    def __init__(self) -> None:
        self.watch, self.t = LampWatch(), 50.0

    def see(self, seconds: float, *states: LinkState, fix: Fix = Fix.GOOD) -> frozenset[Fault]:
        for _ in range(round(seconds / EPOCH_S)):
            self.t += EPOCH_S
            self.watch.on_step(self.t, lights(states, fix), fresh=True)
        return self.watch.faults


def test_lamps_as_they_should_be() -> None:
    watch = Watch()
    assert watch.see(60.0, ACCEPTED, ACCEPTED, FAINT, LinkState.RIM, LinkState.OCCLUDED) == frozenset()


@pytest.mark.parametrize(
    ("states", "fault"),
    [
        ((), Fault.NO_LAMPS),
        ((FAINT, MISSING), Fault.NO_LAMPS),
        ((ACCEPTED, TWIN, TWIN), Fault.TWIN_LAMPS),
        ((ACCEPTED, ACCEPTED, REJECTED), Fault.LAMP_MOVED),
        ((ACCEPTED, ACCEPTED, MISSING), Fault.LAMP_DEAD),
        ((UNSURVEYED, UNSURVEYED, UNSURVEYED), Fault.SURVEY_CONTRADICTED),
        ((ACCEPTED, REJECTED, REJECTED, REJECTED), Fault.SURVEY_CONTRADICTED),
    ],
)
def test_what_lasts_is_named_and_what_passes_is_not(states: tuple[LinkState, ...], fault: Fault) -> None:
    watch = Watch()
    watch.see(5.0, ACCEPTED, ACCEPTED, ACCEPTED)
    assert watch.see(2.0, *states) == frozenset()
    watch.see(5.0, ACCEPTED, ACCEPTED, ACCEPTED)
    assert fault in watch.see(LASTS_S + 1.0, *states)
    assert watch.see(6.0, ACCEPTED, ACCEPTED, ACCEPTED, ACCEPTED) == frozenset()


def test_a_place_given_up_again_and_again_speaks_against_the_survey() -> None:
    watch = Watch()
    for _ in range(6):
        watch.see(1.0, ACCEPTED, ACCEPTED, fix=Fix.LOST)
        faults = watch.see(1.5, ACCEPTED, ACCEPTED, fix=Fix.STARTING)
    assert faults == {Fault.SURVEY_CONTRADICTED}


def test_one_lamp_received_twice_is_two_lamps() -> None:
    watch = LampWatch()
    once = lights((ACCEPTED, ACCEPTED, ACCEPTED))
    twice = replace(once, links=(*once.links, replace(once.links[0], amplitude=1e-8)))
    for turn in range(100):
        watch.on_step(50.0 + turn * EPOCH_S, once, fresh=True)
    assert watch.faults == frozenset()
    for turn in range(100, 200):
        watch.on_step(50.0 + turn * EPOCH_S, twice, fresh=True)
    assert watch.faults == {Fault.TWIN_LAMPS}


def test_one_lamp_too_many_is_no_contradiction() -> None:
    watch = Watch()
    assert watch.see(30.0, ACCEPTED, ACCEPTED, UNSURVEYED, UNSURVEYED, UNSURVEYED) == frozenset()


def test_each_lamp_is_named_once_in_the_log_and_once_when_it_is_well(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    watch = Watch()
    watch.see(30.0, ACCEPTED, REJECTED, MISSING, ACCEPTED, ACCEPTED)
    watch.see(30.0, ACCEPTED, REJECTED, MISSING, ACCEPTED, ACCEPTED)
    watch.see(2.0, ACCEPTED, ACCEPTED, ACCEPTED)
    assert [record.message for record in caplog.records] == [
        "lamp 101 (code 11) differs from its survey: it was moved, exchanged, or its power has changed",
        "lamp 102 (code 12) is not received where it is expected: defective, off, or covered",
        "lamp 101 (code 11) is received as expected again",
        "lamp 102 (code 12) is received as expected again",
    ]


def test_a_lamp_that_went_out_of_view_stays_known_for_a_while() -> None:
    watch = Watch()
    watch.see(12.0, ACCEPTED, ACCEPTED, MISSING)
    assert watch.see(60.0, ACCEPTED, ACCEPTED) == {Fault.LAMP_DEAD}
    watch.t += FORGOTTEN_S
    assert watch.see(1.0, ACCEPTED, ACCEPTED) == frozenset()


def test_blocks_without_strengths_are_counted_and_say_nothing_of_lamps() -> None:
    watch = Watch()
    watch.see(12.0, ACCEPTED, MISSING)
    spoiled = lights((), block=BlockFlag.STALLED)
    for _ in range(400):
        watch.t += EPOCH_S
        watch.watch.on_step(watch.t, spoiled, fresh=True)
    assert watch.watch.stalled == 400
    assert watch.watch.faults == {Fault.LAMP_DEAD}
    watch.watch.on_step(watch.t, lights((), block=BlockFlag.FLAT), fresh=True)
    assert watch.watch.stalled == 400, "darkness is no stall"


@pytest.mark.parametrize(
    ("states", "fault"),
    [((), Fault.NO_LAMPS), ((TWIN, TWIN), Fault.TWIN_LAMPS), ((UNSURVEYED,) * 3, Fault.SURVEY_CONTRADICTED)],
)
@pytest.mark.parametrize("flag", [BlockFlag.SATURATED, BlockFlag.FLAT])
def test_what_is_said_of_all_lamps_does_not_outlast_the_light(
    states: tuple[LinkState, ...], fault: Fault, flag: BlockFlag
) -> None:
    watch = Watch()
    watch.see(12.0, ACCEPTED, ACCEPTED, MISSING)
    watch.see(12.0, *states)
    assert fault in watch.watch.faults

    def blind(seconds: float) -> frozenset[Fault]:
        for _ in range(round(seconds / EPOCH_S)):
            watch.t += EPOCH_S
            watch.watch.on_step(watch.t, lights((), block=flag), fresh=True)
        return watch.watch.faults

    assert fault in blind(1.0), "a moment's flash changes nothing"
    assert blind(3.0) == {Fault.LAMP_DEAD}, "a lamp that was found dead is dead in the dark, too"
    assert fault not in watch.see(2.0, *states), "it has to last anew"


def test_a_step_without_a_block_is_no_epoch() -> None:
    watch = LampWatch()
    for t in range(100):
        watch.on_step(float(t), replace(lights(()), t_mono=0.0), fresh=False)
        watch.on_step(float(t), None, fresh=True)
    assert watch.faults == frozenset()
