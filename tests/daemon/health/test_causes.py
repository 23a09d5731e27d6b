"""Load is one fault: what follows from it stands below it, in the list of faults and in the log."""

import logging
from dataclasses import replace
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.health.assessment import Vitals, assess, describe
from daemon.health.causes import CONSEQUENCES, cause_of, grouped
from daemon.health.faults import Fault
from daemon.runtime.heartbeat import OVER_S, Heartbeat
from hal.lidar import Link

BEFORE = Vitals(0.0, link=Link.STREAMING, cycles=400, scans=400)
WELL = replace(BEFORE, t_mono=10.0, cycles=800, scans=800)
STARVED = replace(WELL, waited=4.0, lateness=0.6, missed=40, late=60, overruns=80, short=80)
"""Another program takes the processor: scans are lost and late, cycles too long and left out."""
OF_LOAD = (Fault.LIDAR_GAPS, Fault.LIDAR_LATE, Fault.LOOP_STALLED, Fault.OVERRUNS, Fault.OVERLOADED)


def test_a_computer_that_is_too_slow_is_one_fault_with_all_that_follows_below_it() -> None:
    found = assess(STARVED, BEFORE)
    assert found == (Fault.COMPUTER_SLOW, *OF_LOAD)
    assert [fault for fault in found if not cause_of(fault, found)] == [Fault.COMPUTER_SLOW]


def test_another_fault_stands_for_itself_and_the_gravest_cause_is_first() -> None:
    found = assess(replace(STARVED, invalid=200, failed=frozenset(["map"])), BEFORE)
    causes = [fault for fault in found if not cause_of(fault, found)]
    assert causes == [Fault.LIDAR_GARBLED, Fault.COMPUTER_SLOW, Fault.MAP_NOT_SAVED]
    assert found[0] is Fault.LIDAR_GARBLED


def test_scans_that_are_lost_on_an_idle_computer_are_a_fault_of_the_line() -> None:
    assert assess(replace(WELL, missed=40), BEFORE) == (Fault.LIDAR_GAPS,)
    assert assess(replace(WELL, missed=40, waited=0.5), BEFORE) == (Fault.LIDAR_GAPS,)
    assert assess(replace(WELL, missed=40, waited=2.0), BEFORE) == (Fault.COMPUTER_SLOW, Fault.LIDAR_GAPS)


def test_a_loop_that_waits_for_the_processor_and_keeps_up_is_no_fault() -> None:
    assert assess(replace(WELL, waited=5.0), BEFORE) == ()


@pytest.mark.parametrize(("waited", "cause"), [(0.0, Fault.LOOP_STALLED), (0.5, Fault.COMPUTER_SLOW)])
def test_a_stall_is_the_computers_only_if_other_programs_had_the_processor(waited: float, cause: Fault) -> None:
    """A process that was stopped, or that its own disk holds up, runs on no slow computer."""
    found = assess(replace(WELL, lateness=0.6, late=60, waited=waited), BEFORE)
    assert [fault for fault in found if not cause_of(fault, found)] == [cause]
    assert set(found) == {cause, Fault.LOOP_STALLED, Fault.LIDAR_LATE}


def test_without_descriptors_nothing_that_cannot_be_opened_stands_for_itself() -> None:
    down = frozenset(["modbus", "map", "odometry", "recorder", "last pose", "flight recorder"])
    found = assess(replace(WELL, no_descriptors=True, failed=down), BEFORE)
    assert found[0] is Fault.NO_DESCRIPTORS
    assert len(found) == 7
    assert all(cause_of(fault, found) == Fault.NO_DESCRIPTORS for fault in found[1:])


@given(st.sets(st.sampled_from([fault for fault in Fault if fault is not Fault.NONE])))
def test_each_fault_stands_behind_its_cause_and_none_is_lost(present: set[Fault]) -> None:
    found = grouped(present)
    assert sorted(found) == sorted(present)
    causes = [fault for fault in found if not cause_of(fault, found)]
    assert causes == sorted(causes), "the gravest first"
    for before, fault in pairwise(found):
        assert cause_of(fault, found) in (0, before, cause_of(before, found))
    assert all(not cause_of(cause_of(fault, found), found) for fault in found), "a cause follows from nothing"


def test_every_reader_of_registers_groups_without_the_daemon() -> None:
    assert cause_of(301, [306, 301]) == 306
    assert cause_of(301, [301]) == cause_of(9999, [306, 9999]) == 0
    assert not set(CONSEQUENCES) & CONSEQUENCES[Fault.NO_DESCRIPTORS]


def test_the_line_says_what_took_the_time() -> None:
    text = describe(Fault.COMPUTER_SLOW, STARVED, BEFORE)
    assert text.startswith("fault 306: the computer is too slow")
    assert text.endswith("used the processor for 4.0 of 10 s, 80 of 400 cycles exceeded their budget")


class Loaded:
    """Vitals of a daemon on a computer that is too slow from beat 10 to beat 40."""

    def __init__(self) -> None:
        self.now = replace(BEFORE, cycles=0, scans=0)
        self.beats = 0

    def sample(self, lateness: float) -> Vitals:
        self.beats += 1
        now = replace(self.now, t_mono=float(self.beats), lateness=lateness)
        now = replace(now, cycles=now.cycles + 40, scans=now.scans + 40)
        if 10 <= self.beats < 40:
            now = replace(now, waited=now.waited + 0.4, missed=now.missed + 4, late=now.late + 6)
            now = replace(now, overruns=now.overruns + 8)
        self.now = now
        return now


def test_the_log_has_one_warning_and_one_end_for_all_that_a_slow_computer_brings(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    loaded = Loaded()
    heart = Heartbeat(loaded.sample, str)
    for beat in range(80):
        heart.beat(0.6 if 10 <= beat < 40 and beat % 3 == 0 else 0.0)
    warnings = [record.message for record in caplog.records if record.levelno >= logging.WARNING]
    assert [text[:10] for text in warnings] == ["fault 306:"]
    over = [text for text in caplog.messages if text.startswith("over: ")]
    assert [text[:16] for text in over] == ["over: fault 306:"]
    below = [text for text in caplog.messages if "follows from fault 306" in text]
    assert {int(text.split()[1]) for text in below} == {106, 107, 301, 302}
    assert len(caplog.messages) == len(warnings) + len(over) + len(below), "each consequence once"
    assert heart.faults == ()


def test_a_consequence_that_comes_and_goes_has_one_line_as_long_as_its_cause_lasts(
    caplog: pytest.LogCaptureFixture,
) -> None:
    caplog.set_level(logging.INFO)
    heart = Heartbeat(lambda lateness: WELL, str)
    for second in range(60):
        late = (Fault.OVERRUNS,) if second % 10 == 0 else ()
        heart._tell(Vitals(float(second)), (Fault.COMPUTER_SLOW, *late))
    assert [text.split(":")[0] for text in caplog.messages] == ["fault 306", "fault 302 follows from fault 306"]


def test_what_outlasts_its_cause_is_named_for_itself(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    heart = Heartbeat(lambda lateness: WELL, str)
    for second in range(4):
        heart._tell(Vitals(float(second)), (Fault.COMPUTER_SLOW, Fault.LIDAR_GAPS))
    for second in range(4, 12):
        heart._tell(Vitals(float(second)), (Fault.LIDAR_GAPS,))
    for second in range(12, 12 + int(OVER_S) + 1):
        heart._tell(Vitals(float(second)), ())
    assert [text.split(":")[0] for text in caplog.messages] == [
        "fault 306",
        "fault 106 follows from fault 306",
        "fault 106",
        "over",
        "over",
    ]
    assert [text[:16] for text in caplog.messages[3:]] == ["over: fault 306:", "over: fault 106:"]
