"""What the fake costs, since it shares a small machine with the daemon it feeds."""

from __future__ import annotations

import asyncio
import time

import numpy as np
import pytest

from hal.fake.lidar.commands import Measure
from hal.fake.lidar.models import UTM_30LX
from hal.fake.lidar.payload import payload
from hal.fake.lidar.scan import FakeScan
from hal.fake.lidar.scip_encoder import measurement, reply
from tests.hal.fake.bench import Talk, virtual

LIMIT_S = 300e-6


@pytest.mark.realtime
def test_a_scan_of_1081_beams_is_encoded_in_less_than_300_us() -> None:
    scan = FakeScan(np.random.default_rng(0).integers(20, 30000, UTM_30LX.steps).astype(np.int32))
    wanted = Measure(0, 1080, 1, 0, 0)
    spent = []
    for _ in range(200):
        begin = time.perf_counter()
        frame = reply(b"MD0000108000000", "99", measurement(0, payload("MD", wanted, scan, 23)))
        spent.append(time.perf_counter() - begin)
    assert len(frame) == 3372
    assert np.median(spent) < LIMIT_S


@pytest.mark.realtime
def test_a_scan_from_the_world_to_the_wire_costs_less_than_twice_that() -> None:
    scan = FakeScan(np.full(UTM_30LX.steps, 5000, dtype=np.int32))

    async def scene(talk: Talk) -> float:
        talk.say("MD0000108000000\n")
        begin = time.process_time()
        await asyncio.sleep(25.0)
        assert talk.device.scans_sent > 900
        return (time.process_time() - begin) / talk.device.scans_sent

    assert virtual(scene, source=lambda _t: scan) < 2 * LIMIT_S
