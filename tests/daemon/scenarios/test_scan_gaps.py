"""Gaps of the lidar, in virtual time: how soon they are shown, and how soon the pose is tracked again after them."""

from __future__ import annotations

import asyncio
import itertools

import pytest

from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS
from daemon.snapshot import State
from hal.fake.lidar.scan_world import Room
from tests.daemon.scenarios.test_daemon import DEVICE, PERIOD, Bench, Parked, run_daemon

SCAN_S = 2.0
"""A valid scan this long after the device answers VV."""
TRACKING_S = 1.0
"""And TRACKING this long after that."""
GAPS = {
    "unplugged": 'what = "hangup"\nfor = 5.0',
    "power": 'what = "off"\nfor = 3.0',
    "silence": 'what = "silence"\nfor = 8.0',
    "stuck": 'what = "stuck"\nfor = 6.0',
    "garbage": 'what = "garbage"\nfor = 6.0\non = "all"',
    "intermittent": 'what = "hangup"\nfor = 0.5',
}


def answered(bench: Bench) -> list[float]:
    """Instants at which the sensor answers VV, from now on."""
    core, times = bench.device._device, []
    send = core.send

    def noted(reply: bytes, *, is_scan: bool = False) -> None:
        if reply.startswith(b"VV\n"):
            times.append(bench.loop.time())
        send(reply, is_scan=is_scan)

    core.send = noted  # type: ignore[method-assign]  # listens, and passes on
    return times


SLOW = [pytest.param(gap, marks=pytest.mark.slow) for gap in ("garbage", "stuck", "intermittent")]


@pytest.mark.parametrize("wheels", [True, False])
@pytest.mark.parametrize("gap", ["unplugged", "power", "silence", *SLOW])
def test_a_gap_is_shown_at_once_and_over_at_once(gap: str, wheels: bool) -> None:
    """With wheels the robot drives through it, without it stands."""

    async def scenario(bench: Bench) -> None:
        sender = asyncio.create_task(bench.send_odometry(60.0)) if wheels else None
        first = await bench.until(State.MAPPING, 3.0)
        await bench.until(State.TRACKING, 6.0)
        await asyncio.sleep(1.0)
        times, before = answered(bench), len(bench.snapshots)
        t_fault = bench.loop.time()
        bench.faults.load(f"[[fault]]\n{GAPS[gap]}")
        gone = await bench.until(State.NO_LIDAR, 2.0)
        assert gone.t_sent - t_fault <= (SILENT_PERIODS + 1.1) * PERIOD
        assert gap != "silence" or gone.reason == Reason.LIDAR_SILENT
        tracked = await bench.until(State.TRACKING, 30.0)
        back = next(s for s in reversed(bench.snapshots) if s.lidar_ok is False)  # a cycle later a scan was there
        assert tracked.t_sent - back.t_sent <= TRACKING_S + PERIOD
        if times:
            assert back.t_sent - times[-1] <= SCAN_S
        said = [s.state for s in bench.snapshots[before:]]
        losses = sum(a is not b and b is State.NO_LIDAR for a, b in itertools.pairwise(said))
        assert losses == 1 or (gap == "stuck" and losses <= 3), "a stuck sensor sends one scan whenever it is restarted"
        await asyncio.sleep(2.0)
        assert bench.last.state is State.TRACKING
        off_m, off_rad = bench.off(bench.last, first)
        assert off_m < 0.1
        assert off_rad < 0.03
        if sender is not None:
            sender.cancel()

    run_daemon(scenario, world=Room if wheels else Parked)


def test_in_a_gap_that_nothing_bridges_the_stated_uncertainty_grows() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(State.TRACKING, 6.0)
        held = bench.last.covariance
        bench.opener.unplug(DEVICE)
        await asyncio.sleep(5.0)
        grown = bench.last.covariance
        assert held is not None
        assert grown is not None
        assert grown[0] > 1.0 > held[0], "half a metre a second: it may have been pushed"
        bench.opener.plug(DEVICE, bench.device)
        await bench.until(State.TRACKING, 15.0)
        back = bench.last.covariance
        assert back is not None
        assert back[0] < 0.01

    run_daemon(scenario, world=Parked)
