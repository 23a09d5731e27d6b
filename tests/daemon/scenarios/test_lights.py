"""The daemon with a photodiode, in virtual time: the real driver on a fake bus, real decoder, every word carried."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from daemon.app import Daemon, Environment
from daemon.config.endpoints import NO_DEVICE
from daemon.config.schema import Config, LidarConfig, LightsConfig, ModbusConfig, PhotodiodeConfig
from daemon.config.survey_loader import SurveyError
from daemon.devices.light_setup import Lights, load_lights
from daemon.devices.photodiode import BlockWatch
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot
from estimator.cdma.air_interface import PROFILE_A, PROFILE_B
from hal.adc import AdcStatus
from hal.clock import LoopClock, run_virtual
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import URG_04LX_UG01
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from tests.daemon.support.light_room import BUS, CODES, SURVEY, Lit, plugged, raw_block
from tests.daemon.support.whole_daemon import during

LIDAR = "/dev/ttyACM0"
BLOCK_S = PROFILE_A.epoch_s


def settings(lidar: bool, light: bool, level: bool = False) -> Config:
    return Config(
        lidar=LidarConfig(device=LIDAR if lidar else NO_DEVICE),
        photodiode=PhotodiodeConfig(bus=BUS if light else "", level="ads1115@0x48/0" if level else ""),
        modbus=ModbusConfig(port=0),
    )


async def warm() -> None:
    """Nothing to load: the estimator compiles on first use in this process."""


@dataclass
class Bench:
    """A daemon with its lidar and its photodiode, each as configured; `order` takes faults of the converter."""

    lidar: bool = False
    light: bool = True
    level: bool = False
    codes: Sequence[int] = CODES
    lights: Lights = field(default_factory=lambda: Lights(SURVEY, PROFILE_A, 0.0))
    snapshots: list[Snapshot] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        clock = LoopClock(self.loop, utc_at_zero=1.7e9)
        self.source = Lit(self.codes)
        self.buses, self.adc = plugged(clock, self.source)
        if self.level:
            self.adc.add_level(lambda t_mono: np.full_like(t_mono, 0.4))
        self.device = FakeHokuyo(URG_04LX_UG01, Room(URG_04LX_UG01))
        self.opener = FakeOpener(clock)
        self.opener.plug(LIDAR, self.device)
        self.faults = FaultSchedule({"adc": self.adc})
        self.world = Environment(
            clock,
            opener=self.opener,
            make_worker=CycleWorker,
            make_budget=FixedBudget,
            stopwatch=None,
            warm_up=warm,
            sinks=(self.snapshots.append,),
            draw_map_id=lambda: 1,
            buses=self.buses,
            lights=self.lights if self.light else None,
        )
        self.daemon = self.make()

    def make(self) -> Daemon:
        return Daemon(settings(self.lidar, self.light, self.level), self.world)

    @property
    def last(self) -> Snapshot:
        return self.snapshots[-1]

    def order(self, toml: str) -> None:
        self.faults.load("[[fault]]\n" + toml.replace("; ", "\n"))

    async def until(self, so: Callable[[Snapshot], bool], seconds: float) -> Snapshot:
        """The first snapshot for which something holds, at most ``seconds`` from now."""
        end, seen = self.loop.time() + seconds, len(self.snapshots)
        while self.loop.time() < end:
            for snapshot in self.snapshots[seen:]:
                if so(snapshot):
                    return snapshot
            seen = len(self.snapshots)
            await asyncio.sleep(0.01)
        raise AssertionError(f"not within {seconds} s; {self.last}")


def run_daemon(scenario: Callable[[Bench], Awaitable[None]], **options: object) -> Bench:
    """Run the daemon around a scenario and stop it as a signal would."""

    async def go() -> Bench:
        bench = Bench(**options)  # type: ignore[arg-type]  # test shorthand
        await during(bench.daemon, scenario(bench))
        return bench

    return run_virtual(go(), start=100.0)


def decoded(snapshot: Snapshot) -> bool:
    return snapshot.links == len(CODES)


def test_lights_alone_a_cycle_a_block_and_lamps_come_out() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(decoded, 3.0)
        since = len(bench.snapshots)
        await asyncio.sleep(1.0)
        last = bench.last
        assert (last.adc_ok, last.lidar_ok, last.scan_rate) == (True, None, None)
        steps = [after.t_sent - before.t_sent for before, after in pairwise(bench.snapshots[since:])]
        assert max(abs(step - BLOCK_S) for step in steps) < 0.1 * BLOCK_S, "one cycle a block"
        result = bench.daemon.cycle.result
        assert result is not None
        assert result.lights is not None
        assert {link.code for link in result.lights.links} == set(CODES)

    run_daemon(scenario)


def test_both_sensors_one_cycle_a_scan_and_no_block_is_lost() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(decoded, 6.0)
        cycle = bench.daemon.cycle
        scans, blocks = bench.daemon.lidar.status.scans, bench.daemon.adc.status.blocks
        since = cycle.cycles
        await asyncio.sleep(5.0)
        scans, blocks = bench.daemon.lidar.status.scans - scans, bench.daemon.adc.status.blocks - blocks
        assert abs(cycle.cycles - since - scans) <= 1
        assert blocks == pytest.approx(5.0 / BLOCK_S, rel=0.05)
        assert cycle.inbox.blocks_dropped == 0
        assert (bench.last.lidar_ok, bench.last.adc_ok) == (True, True)
        assert bench.last.pose is not None

    run_daemon(scenario, lidar=True)


def test_without_a_photodiode_nothing_is_said_of_one() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(lambda snapshot: snapshot.pose is not None, 4.0)
        assert (bench.last.lidar_ok, bench.last.adc_ok, bench.last.links) == (True, None, None)
        assert bench.buses.opened == 0

    run_daemon(scenario, lidar=True, light=False)


def test_blocks_of_a_millisecond_may_come_late_together() -> None:
    """An adapter that reads 60 bytes at a time, on a computer that hands them over when it comes to it."""
    watch = BlockWatch(AdcStatus(), PROFILE_A)
    assert not watch.ok(10.0)
    watch.on_block(replace(raw_block(0), words=np.zeros(30, np.uint16)))
    t_last = raw_block(0).t1
    assert watch.seconds < 2e-3
    assert watch.ok(t_last + 2.5 * BLOCK_S)
    assert not watch.ok(t_last + 3.5 * BLOCK_S)


def test_a_lidar_that_goes_leaves_the_pace_to_the_lights_and_takes_it_back(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.WARNING)

    async def scenario(bench: Bench) -> None:
        await bench.until(decoded, 6.0)
        bench.opener.unplug(LIDAR)
        await bench.until(lambda snapshot: snapshot.lidar_ok is False, 1.0)
        since, begun = bench.daemon.cycle.cycles, bench.loop.time()
        await asyncio.sleep(2.0)
        cycles = bench.daemon.cycle.cycles - since
        assert cycles >= (bench.loop.time() - begun) / BLOCK_S - 2
        assert bench.last.adc_ok
        assert decoded(bench.last)
        bench.opener.plug(LIDAR, bench.device)
        await bench.until(lambda snapshot: bool(snapshot.lidar_ok), 10.0)
        assert bench.daemon.cycle.inbox.blocks_dropped == 0

    run_daemon(scenario, lidar=True)


def test_a_survey_is_read_for_the_configured_profile(tmp_path: Path) -> None:
    path = tmp_path / "lights.toml"

    def load(code: int, profile: str) -> Lights | None:
        path.write_text(f"lamp = [ {{ lamp_id = 1, code = {code}, x = 0.0, y = 0.0, z = 2.6 }} ]")
        photodiode = PhotodiodeConfig(bus=BUS, profile=profile)
        return load_lights(Config(photodiode=photodiode, lights=LightsConfig(survey=str(path))))

    lights = load(64, "B")
    assert lights is not None
    assert lights.survey.depth == PROFILE_B.depth
    assert load(512, "D") is not None
    with pytest.raises(SurveyError, match=r"lamp 1: code 65 is not in profile B, which has codes 0 to 64"):
        load(65, "B")


def test_lamps_that_describe_themselves_are_modulated_as_the_profile_says() -> None:
    lights = load_lights(Config(photodiode=PhotodiodeConfig(bus=BUS, profile="B")))
    assert lights is not None
    assert lights.survey.depth == PROFILE_B.depth != PROFILE_A.depth
