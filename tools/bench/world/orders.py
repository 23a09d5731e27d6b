"""A scenario's faults, looked at before anything is played: words, arguments, and what the devices can do at all."""

import asyncio
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from hal.clock import SystemClock
from hal.fake.adc.converter import FakeAdc
from hal.fake.adc.light import OrdinaryLamps
from hal.fake.faults.orders import FaultError, read_fault
from hal.fake.faults.schedule import Target
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import LidarModel
from hal.fake.lidar.scan_world import Room
from tools.sim.robot import hands


def check(tables: Sequence[Mapping[str, Any]], lidar: LidarModel, lamps: bool) -> None:
    """Of all ``[[fault]]`` tables, on this lidar, and on a converter where there are lamps.

    Raises:
        ValueError: one of them cannot be ordered; the text begins with its number, from 1.
    """
    if not tables:
        return
    with _devices(lidar, lamps) as devices:
        words = {name: device.vocabulary for name, device in devices.items()} | {"robot": hands.VOCABULARY}
        for number, table in enumerate(tables, 1):
            try:
                fault = read_fault(table, f"fault[{number - 1}]", words)
                if fault.where in devices:
                    devices[fault.where].check(fault)
            except FaultError as error:
                raise ValueError(f"[[fault]] number {number}: {error}") from error


@contextmanager
def _devices(lidar: LidarModel, lamps: bool) -> Iterator[dict[str, Target]]:
    """Those that take orders, which nothing is connected to."""
    loop = asyncio.new_event_loop()
    sensor = FakeHokuyo(lidar, Room(lidar), loop=loop)
    try:
        adc: dict[str, Target] = {"adc": FakeAdc(OrdinaryLamps(), SystemClock())} if lamps else {}
        yield {"lidar": sensor, **adc}
    finally:
        sensor.close()
        loop.close()
