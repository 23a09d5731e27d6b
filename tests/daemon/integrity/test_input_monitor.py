"""Data that come, and come wrongly: late scans, odometry that is lost, late or seldom, a laser at odds with the map."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest

from daemon.health.reasons import Reason
from daemon.integrity.input_monitor import Watch
from daemon.integrity.state_memory import Memory
from daemon.snapshot import State
from hal.odometry import RawOdometry
from tests.daemon.support.room import raw_scan

PERIOD = 0.1


def reading(t_rx: float, age: float = 0.0, missed: int = 0) -> RawOdometry:
    return RawOdometry(t_rx, t_rx - age, 0.0, 0.0, 0.0, missed)


def test_lost_and_late_readings_are_counted_but_not_those_of_a_silence() -> None:
    watch = Watch()
    watch.on_odometry(reading(0.0))
    watch.on_odometry(reading(0.04, missed=1))
    watch.on_odometry(reading(0.06, age=0.3))
    watch.on_odometry(reading(0.08, age=0.1))
    assert (watch.readings, watch.missed, watch.old) == (4, 1, 1)
    watch.on_odometry(reading(9.0, missed=400))
    assert (watch.readings, watch.missed) == (5, 1), "silence has a fault of its own"


def test_late_scans_are_counted() -> None:
    watch, scan = Watch(), raw_scan(0, 5.0)
    watch.on_scan(replace(scan, t_rx=5.13), PERIOD)
    assert watch.late == 0
    watch.on_scan(replace(scan, t_rx=5.4), PERIOD)
    assert watch.late == 1


ODD = Memory(State.RELOCATING, Reason.SEARCHING)
FIT = Memory(State.TRACKING, Reason.NONE)


def judged(watch: Watch, begin: float, end: float, memory: Memory) -> bool:
    """What is said after verdicts ten times a second."""
    for k in range(round(10 * begin), round(10 * end) + 1):
        watch.on_verdict(k / 10, memory, scans=True)
    return watch.misfit


def test_a_laser_at_odds_with_a_place_that_was_known() -> None:
    watch = Watch()
    assert not judged(watch, 0.0, 3.0, FIT)
    assert not judged(watch, 3.1, 3.1, Memory(State.DEGRADED, Reason.MATCH_FAILED))
    assert not judged(watch, 3.2, 4.9, Memory(State.DEGRADED, Reason.CONFIRMING))
    assert judged(watch, 5.0, 5.2, ODD)
    watch.on_verdict(5.3, ODD, scans=False)
    assert not watch.misfit, "a laser that is silent says nothing"
    assert judged(watch, 6.0, 9.0, ODD)
    assert not judged(watch, 9.1, 11.0, FIT)


@pytest.mark.parametrize("reason", [Reason.UNCERTAIN, Reason.NO_WITNESS])
def test_a_pose_that_is_only_uncertain_is_no_laser_at_odds(reason: Reason) -> None:
    watch = Watch()
    assert not judged(watch, 0.0, 3.0, FIT)
    assert not judged(watch, 3.1, 9.0, Memory(State.LOST, reason))
    assert judged(watch, 9.1, 12.0, Memory(State.LOST, reason, failed=1))


def test_wrong_ranges_that_fit_for_a_moment_are_wrong_all_the_same() -> None:
    watch = Watch()
    assert not judged(watch, 0.0, 3.0, FIT)
    assert judged(watch, 3.1, 5.3, ODD)
    assert judged(watch, 5.4, 6.4, FIT), "the heartbeat looks once a second"
    assert judged(watch, 6.5, 7.0, ODD)
    assert not judged(watch, 7.1, 9.0, FIT)
    assert not judged(watch, 9.1, 10.0, ODD), "what has fitted for longer begins anew"


def test_a_laser_that_fits_nowhere_in_the_map_after_a_start() -> None:
    watch = Watch()
    assert not judged(watch, 0.0, 4.5, ODD), "the place is being looked for"
    assert not judged(watch, 4.6, 9.0, Memory(State.AMBIGUOUS, Reason.SEVERAL_PLACES)), "several fit"
    assert not judged(watch, 9.1, 14.0, ODD)
    assert judged(watch, 14.1, 14.2, ODD)
    assert not judged(watch, 14.3, 14.3, Memory(State.MAPPING, Reason.UNPROVED))


def test_scans_that_have_not_fitted_once_are_no_fault_for_ever() -> None:
    watch = Watch()
    watch.on_verdict(0.0, Memory(State.TRACKING, Reason.NONE), scans=True)
    watch.on_verdict(0.1, Memory(State.DEGRADED, Reason.MATCH_FAILED), scans=True)
    for k in range(1, 150):
        watch.on_verdict(0.1 + 0.1 * k, Memory(State.DEGRADED, Reason.LIGHT_DARK), scans=True)
    assert not watch.misfit


def test_disagreement_counts_whatever_else_is_said() -> None:
    watch = Watch()
    memory = Memory(State.DEGRADED, Reason.LIGHT_LOST, disagree_since=5.0)
    watch.on_verdict(5.5, memory, scans=True)
    assert not watch.disagree
    watch.on_verdict(6.1, memory, scans=True)
    assert watch.disagree
    watch.on_verdict(6.2, msgspec.structs.replace(memory, disagree_since=None), scans=True)
    assert not watch.disagree
