"""A lidar that repeats one scan while the robot moves: the cycle counts its scans and does not use them."""

import asyncio
from dataclasses import replace

from tests.daemon.runtime.test_cycle import PERIOD, Bench, on_bench
from tests.daemon.support.room import error, raw_odometry, raw_scan


def test_scans_that_repeat_one_while_odometry_moves_are_counted_and_odometry_carries_the_pose() -> None:
    async def freeze(bench: Bench) -> None:
        await bench.drive(0, 60, odometry=True)
        assert bench.cycle.facts().scans_repeated == 0
        loop, last = asyncio.get_running_loop(), raw_scan(59, 59 * PERIOD)
        for seq in range(60, 80):
            scan = raw_scan(seq, seq * PERIOD)
            await asyncio.sleep(max(0.0, scan.t_rx - loop.time()))
            bench.cycle.inbox.put_odometry(raw_odometry(loop.time()))
            bench.pacemaker.on_scan(replace(scan, ranges=last.ranges))
            await asyncio.sleep(0)

    bench = on_bench(freeze, odometry=True)
    assert bench.cycle.facts().scans_repeated >= 15
    last = bench.snapshots[-1]
    assert last.pose is not None
    assert error(last.pose, last.t_mono)[0] < 0.05
