"""A lidar that vanishes, falls silent, sends damaged frames, or was never there."""

from __future__ import annotations

import asyncio
import logging
from itertools import pairwise

import pytest

from daemon.health.faults import Fault
from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS
from daemon.snapshot import Snapshot, State
from tests.daemon.scenarios.test_daemon import DEVICE, PERIOD, Bench, Parked, run_daemon


def test_a_lidar_that_vanishes_and_returns(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    async def scenario(bench: Bench) -> None:
        sender = asyncio.create_task(bench.send_odometry(60.0))
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        last_scan = bench.daemon.cycle.observer._t_scan
        bench.opener.unplug(DEVICE)
        gone = await bench.until(State.NO_LIDAR, 2.0)
        assert last_scan is not None
        assert gone.t_sent - last_scan <= (SILENT_PERIODS + 1.1) * PERIOD
        await asyncio.sleep(3.0)
        assert bench.last.fault == Fault.LIDAR_MISSING
        assert bench.last.reason == Reason.LIDAR_UNREACHABLE
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 20.0)
        off_m, off_rad = bench.off(bench.last, first)
        assert off_m < 0.1
        assert off_rad < 0.03
        await asyncio.sleep(12.0)
        assert bench.last.fault == 0
        sender.cancel()

    run_daemon(scenario)
    lost = [r.message for r in caplog.records if "lidar lost" in r.message]
    assert len(lost) == 2, "unplugged; no such device: once each"
    assert all(DEVICE in line for line in lost)
    assert sum("delivers again" in r.message for r in caplog.records) == 1


@pytest.mark.parametrize("after_s", [0.0, 6.0])
def test_a_lidar_that_never_answers_does_not_make_the_state_flicker(
    after_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)

    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(after_s)
        bench.faults.load('[[fault]]\nwhat = "silence"\nwhen = 0.0\nfor = 125.0\n')
        since = len(bench.snapshots)
        await asyncio.sleep(120.0)
        said = [(snapshot.state, snapshot.reason) for snapshot in bench.snapshots[since:]]
        news = [after for before, after in pairwise(said) if before != after]
        assert len(news) <= 3
        assert said[-1] == (State.NO_LIDAR, Reason.LIDAR_UNREACHABLE)
        await asyncio.sleep(20.0)
        assert bench.last.lidar_ok, "and it has not given up"

    run_daemon(scenario)
    assert sum("NO_LIDAR" in record.message for record in caplog.records) <= 2


def test_a_gap_that_nothing_bridged_is_not_called_tracking_unless_it_is_right() -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        bench.opener.unplug(DEVICE)
        await asyncio.sleep(5.0)
        bench.opener.plug(DEVICE, bench.device)
        since = len(bench.snapshots)
        await asyncio.sleep(30.0)
        assert bench.last.lidar_ok
        assert bench.last.state is not State.NO_LIDAR
        _never_wrong(bench, first)
        assert all(s.pose is not None for s in bench.snapshots[since:])

    run_daemon(scenario)


def test_a_robot_that_stood_still_through_a_gap_is_tracking_again() -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        bench.opener.unplug(DEVICE)
        await asyncio.sleep(20.0)
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 15.0)
        _never_wrong(bench, first)

    run_daemon(scenario, world=Parked)


def _never_wrong(bench: Bench, first: Snapshot) -> None:
    for snapshot in bench.snapshots:
        if snapshot.pose is not None and snapshot.state is State.TRACKING:
            off_m, off_rad = bench.off(snapshot, first)
            assert off_m < 0.1
            assert off_rad < 0.03


def test_no_lidar_from_the_start_is_said_and_mended_by_plugging_it_in() -> None:
    async def scenario(bench: Bench) -> None:
        missing = await bench.until(State.NO_LIDAR, 1.0)
        assert missing.reason == Reason.LIDAR_UNREACHABLE
        await asyncio.sleep(30.0)
        assert bench.last.state is State.NO_LIDAR
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 12.0)

    run_daemon(scenario, plugged=False)


@pytest.mark.parametrize(
    "order",
    [
        'what = "garbage"\nfor = 4.0\nshare = 0.3\non = "scans"',
        'what = "bit_flip"\nfor = 4.0\nshare = 0.5',
        'what = "cut_frame"\nfor = 4.0\nshare = 0.3',
        'what = "chunks"\nfor = 4.0\npiece = 7\nsplit_end = true',
        'what = "stall"\nfor = 2.0',
        'what = "reset"',
    ],
)
def test_trouble_on_the_line_never_makes_a_wrong_pose(order: str) -> None:
    async def scenario(bench: Bench) -> None:
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        bench.faults.load(f"[[fault]]\n{order}")
        await asyncio.sleep(25.0)
        assert bench.last.lidar_ok
        _never_wrong(bench, first)

    run_daemon(scenario)


def test_damaged_frames_are_counted_and_named() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.TRACKING, 6.0)
        bench.faults.load('[[fault]]\nwhat = "bit_flip"\nfor = 10.0\nevery = 4')
        await asyncio.sleep(8.0)
        assert bench.daemon.heartbeat.faults[0] is Fault.LIDAR_GARBLED
        assert bench.last.missed >= 15
        await asyncio.sleep(20.0)
        assert bench.daemon.heartbeat.faults == ()

    run_daemon(scenario)


def test_a_sensor_that_falls_silent_without_a_word() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.TRACKING, 6.0)
        bench.faults.load('[[fault]]\nwhat = "silence"\nfor = 8.0')
        silent = await bench.until(State.NO_LIDAR, 1.0)
        assert silent.reason == Reason.LIDAR_SILENT
        await asyncio.sleep(2.0)
        assert bench.last.fault in (Fault.LIDAR_SILENT, Fault.LIDAR_BROKEN)
        await bench.until(State.TRACKING, 40.0)

    run_daemon(scenario, world=Parked)
