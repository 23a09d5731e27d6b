"""What waits for the next cycle: one scan, all motion, bounded whatever arrives; and the scan period learned."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.network import OneSender
from daemon.runtime.inbox import BLOCKS, DEEPEST, Inbox
from daemon.runtime.scan_period import IDLE_PERIOD_S, ScanPeriod
from estimator.measurements import Command, Order
from hal.imu import RawImu
from hal.odometry import RawOdometry
from tests.daemon.support.light_room import raw_block
from tests.daemon.support.room import URG, raw_scan

SCAN = raw_scan(0, 0.0)


def at(seq: int, t_mono: float, period: float = URG.period_s):  # type: ignore[no-untyped-def]  # a RawScan
    return replace(SCAN, seq=seq, t_mono=t_mono, geometry=replace(URG, period_s=period))


def test_taking_empties_it() -> None:
    inbox = Inbox()
    inbox.put_scan(SCAN)
    inbox.put_odometry(RawOdometry(0, 0, 1, 2, 3))
    inbox.put_imu(RawImu(0, 0, 1))
    inbox.put_command(Command(0.0, Order.RESET))
    taken = inbox.drain()
    assert taken.scan is SCAN
    assert (len(taken.odometry), len(taken.imu), len(taken.commands)) == (1, 1, 1)
    empty = inbox.drain()
    assert (empty.scan, empty.odometry, empty.imu, empty.commands, empty.dropped) == (None, (), (), (), ())
    assert (empty.odometry_total, empty.imu_total) == (1, 1)


@given(count=st.integers(0, 5 * DEEPEST))
def test_the_first_and_the_last_odometry_survive_any_flood(count: int) -> None:
    inbox = Inbox()
    for i in range(count):
        inbox.put_odometry(RawOdometry(i, i, i, 0, 0))
        inbox.put_imu(RawImu(i, i, 0))
    taken = inbox.drain()
    assert taken.odometry_total == taken.imu_total == count
    assert len(taken.odometry) <= DEEPEST
    assert len(taken.imu) <= DEEPEST
    if count:
        assert taken.odometry[0].x == 0
        assert taken.odometry[-1].x == count - 1
        assert [r.x for r in taken.odometry] == sorted({r.x for r in taken.odometry})


def test_the_latest_few_blocks_wait_in_order_and_the_others_are_counted() -> None:
    inbox = Inbox()
    for seq in range(BLOCKS + 3):
        inbox.put_samples(raw_block(seq))
    taken = inbox.drain()
    assert [block.seq for block in taken.samples] == list(range(3, BLOCKS + 3))
    assert (taken.samples_total, inbox.blocks_dropped) == (BLOCKS + 3, 3)
    assert inbox.drain().samples == ()
    inbox.begin()
    assert inbox.blocks_dropped == 0, "before there was a cycle nothing was lost"


def test_scans_from_before_the_first_cycle_are_no_loss() -> None:
    inbox = Inbox()
    for seq in range(5):
        inbox.put_scan(replace(SCAN, seq=seq))
    inbox.begin()
    assert inbox.dropped == 0
    assert inbox.drain().dropped == (0, 1, 2, 3), "a recording has to know them all the same"


def test_the_period_is_idle_then_nominal_then_learned() -> None:
    period = ScanPeriod()
    assert period.seconds == IDLE_PERIOD_S
    period.learn(at(0, 0.0, period=0.025))
    assert period.seconds == 0.025
    for seq in range(1, 10):
        period.learn(at(seq, 0.02505 * seq, period=0.025))
    assert period.seconds == pytest.approx(0.02505)


def test_gaps_and_stamps_that_run_backwards_do_not_move_the_period() -> None:
    period = ScanPeriod()
    t = 0.0
    for seq in range(40):
        t += 0.1 * (3 if seq == 20 else 1)
        period.learn(at(seq * 2, t * 2 if seq != 30 else t))
    assert period.seconds == pytest.approx(0.1)


def test_one_sender_of_odometry_at_a_time(caplog: pytest.LogCaptureFixture) -> None:
    passed: list[float] = []
    gate = OneSender(lambda reading: passed.append(reading.x))
    for i in range(10):
        gate.receive("UDP", RawOdometry(0.1 * i, 0.1 * i, 1.0, 0, 0))
        gate.receive("Modbus", RawOdometry(0.1 * i, 0.1 * i, 2.0, 0, 0))
    assert passed == [1.0] * 10
    gate.receive("Modbus", RawOdometry(2.5, 2.5, 2.0, 0, 0))
    assert passed[-1] == 2.0
    assert len([r for r in caplog.records if "is ignored" in r.message]) == 1
    for t in (103.0, 103.1):  # on another day it is news
        gate.receive("UDP", RawOdometry(t, t, 1.0, 0, 0))
        gate.receive("Modbus", RawOdometry(t, t, 2.0, 0, 0))
    assert len([r for r in caplog.records if "is ignored" in r.message]) == 2


def test_without_scans_blocks_set_the_pace_until_there_is_one() -> None:
    period = ScanPeriod()
    period.learn_block(0.05)
    assert period.seconds == 0.05
    period.learn(at(0, 0.0))
    period.learn_block(0.05)
    assert period.seconds == URG.period_s
