"""A lidar that never answers, a gap that nothing bridges, and damaged frames."""

from __future__ import annotations

import asyncio
import logging
from itertools import pairwise

import pytest

from daemon.health.faults import Fault
from daemon.health.reasons import Reason
from daemon.snapshot import Snapshot, State
from tests.daemon.scenarios.test_daemon import DEVICE, Bench, run_daemon


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


def _never_wrong(bench: Bench, first: Snapshot) -> None:
    for snapshot in bench.snapshots:
        if snapshot.pose is not None and snapshot.state is State.TRACKING:
            off_m, off_rad = bench.off(snapshot, first)
            assert off_m < 0.1
            assert off_rad < 0.03


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
