"""Everything a bus, a chip and the light can do wrong: named in health by a number of its own, and over with it."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass

import pytest

from daemon.health.faults import FAULTS, Fault
from daemon.snapshot import LightPicture, State
from estimator.cdma.air_interface import PROFILE_A
from hal.fake.adc.faults import ERRORS
from hal.fake.lidar.models import URG_04LX_UG01
from tests.daemon.scenarios.test_lights import Bench, decoded, run_daemon
from tests.daemon.support.light_room import CODES, CURRENTS_A


@dataclass(frozen=True)
class Case:
    """An order, the fault it is named as, and within how many seconds.

    ``start``: it is there before the daemon is. ``lit``: it only shows where there are lamps.
    """

    order: str
    fault: Fault
    within: float = 4.0
    start: bool = False
    lit: bool = False


def named(name: str) -> Fault:
    if name in ("ENXIO", "EREMOTEIO"):
        return Fault.ADC_MISSING
    if name in ("EACCES", "EBUSY", "EOPNOTSUPP", "EINVAL"):
        return Fault.ADC_BUS_REFUSED
    if name in ("ENODEV", "ESHUTDOWN", "ENOENT"):
        return Fault.ADC_BUS_MISSING
    return Fault.ADC_BUS_STUCK if name == "ETIMEDOUT" else Fault.ADC_BUS_FAULTY


CASES = [
    *(Case(f"what = 'error'; name = '{name}'; on = 'all'", named(name), within=12.0) for name in ERRORS),
    Case("what = 'gone'", Fault.ADC_BUS_MISSING),
    Case("what = 'gone'", Fault.ADC_BUS_MISSING, start=True),
    Case("what = 'refuse'", Fault.ADC_BUS_REFUSED, start=True),
    Case("what = 'off'", Fault.ADC_MISSING),
    Case("what = 'moved'; address = 0x4f", Fault.ADC_MISSING),
    Case("what = 'replaced'; chip = 'ADS1115'", Fault.ADC_WRONG),
    Case("what = 'replaced'; chip = 'ADS1115'", Fault.ADC_WRONG, start=True),
    Case("what = 'replaced'; chip = 'LM75'", Fault.ADC_GARBLED),
    Case("what = 'hang'", Fault.ADC_BUS_STUCK, within=12.0),
    Case("what = 'delayed'; by_s = 4.0", Fault.ADC_BUS_STUCK, within=6.0),
    Case("what = 'floats'", Fault.ADC_BUS_FAULTY),
    Case("what = 'stuck'", Fault.NO_SIGNAL),
    Case("what = 'saturated'", Fault.NO_SIGNAL),
    Case("what = 'dark'", Fault.NO_SIGNAL),
    Case("what = 'clip'; gain = 40", Fault.CLIPPED),
    Case("what = 'short'; every = 4", Fault.ADC_GARBLED, within=12.0),
    Case("what = 'stall'; us = 3000; every = 4", Fault.ADC_STALLS, within=12.0, lit=True),
    Case("what = 'scl'; percent = -8.0", Fault.ADC_RATE, within=12.0),
]


LONG = ("short", "scl", "clip", "saturated", "EAGAIN", "EINVAL", "ENOMEM", "EBUSY", "ESHUTDOWN", "ENOENT", "EPROTO")
"""Told by what others tell as well; they run with the slow ones."""


def parameter(case: Case) -> object:
    marks = [pytest.mark.slow] if any(word in case.order for word in LONG) else []
    return pytest.param(case, marks=marks, id=f"{case.order}{' from the start' if case.start else ''}")


@pytest.mark.parametrize("case", [parameter(case) for case in CASES])
def test_each_trouble_has_a_name_and_an_end(case: Case, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)

    async def scenario(bench: Bench) -> None:
        if not case.start:
            await bench.until(decoded if case.lit else lambda snapshot: bool(snapshot.adc_ok), 4.0)
        bench.order(case.order)
        shown = await bench.until(lambda snapshot: snapshot.fault == case.fault, case.within)
        assert shown.state is not State.TRACKING
        await asyncio.sleep(1.0)
        bench.faults.clear()
        await bench.until(lambda snapshot: bool(snapshot.adc_ok) and snapshot.fault != case.fault, 15.0)

    run_daemon(scenario, codes=CODES if case.lit else ())
    text, remedy = FAULTS[case.fault]
    assert text
    assert remedy
    assert len([record for record in caplog.records if record.levelno >= logging.WARNING]) <= 6, "said, not shouted"


def test_with_a_lidar_the_pose_goes_on_and_says_what_is_missing() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(decoded, 6.0)
        bench.order("what = 'off'")
        await bench.until(lambda snapshot: snapshot.fault == Fault.ADC_MISSING, 4.0)
        since = len(bench.snapshots)
        await asyncio.sleep(3.0)
        for snapshot in bench.snapshots[since:]:
            assert (snapshot.lidar_ok, snapshot.adc_ok) == (True, False)
            assert snapshot.pose is not None
            assert snapshot.links == 0 or snapshot.state is not State.TRACKING

    run_daemon(scenario, lidar=True)


@pytest.mark.parametrize("order", ["what = 'off'", "what = 'hang'", "what = 'gone'"])
@pytest.mark.parametrize("lidar", [True, False])
def test_a_converter_that_falls_silent_is_shown_within_five_blocks(order: str, lidar: bool) -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(lambda snapshot: bool(snapshot.adc_ok) and snapshot.pose is not None, 6.0)
        begun = bench.loop.time()
        bench.order(order)
        shown = await bench.until(lambda snapshot: snapshot.adc_ok is False, 2.0)
        cycle = 1.5 * (URG_04LX_UG01.true_period_s if lidar else PROFILE_A.epoch_s)
        assert shown.t_sent - begun <= 5.0 * PROFILE_A.epoch_s + cycle
        assert shown.light == LightPicture(blocks=shown.light.blocks, blocks_lost=shown.light.blocks_lost)
        assert (shown.links, shown.light_id) == (0, None), "no link of before is shown"

    run_daemon(scenario, lidar=lidar)


def test_dark_and_dazzled_are_told_apart_by_a_dc_channel() -> None:
    async def scenario(bench: Bench) -> None:
        await bench.until(decoded, 4.0)
        for what, fault in (("dark", Fault.DARK), ("saturated", Fault.DAZZLED)):
            bench.order(f"what = '{what}'")
            await bench.until(lambda snapshot, fault=fault: snapshot.fault == fault, 6.0)
            bench.faults.clear()
            await bench.until(lambda snapshot: snapshot.fault == Fault.NONE, 15.0)

    run_daemon(scenario, level=True)


def test_light_without_lamps_in_it_is_named() -> None:
    async def scenario(bench: Bench) -> None:
        bench.source.under(())
        shown = await bench.until(lambda snapshot: snapshot.fault == Fault.NO_LAMPS, 14.0)
        assert (shown.links, shown.adc_ok) == (0, True)
        bench.source.under(CODES, CURRENTS_A)
        await bench.until(decoded, 8.0)
        await bench.until(lambda snapshot: snapshot.fault == Fault.NONE, 6.0)

    run_daemon(scenario)


def test_two_lamps_with_one_code_are_named() -> None:
    async def scenario(bench: Bench) -> None:
        bench.source.under((*CODES, CODES[0]), (*CURRENTS_A, 1.1e-6))
        await bench.until(lambda snapshot: snapshot.fault == Fault.TWIN_LAMPS, 14.0)

    run_daemon(scenario)
