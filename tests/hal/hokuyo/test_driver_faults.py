"""Every fault the fake sensor knows, ordered while the driver streams: it comes back, nothing false gets through."""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field

import numpy as np
import pytest

from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.models import MODELS, UST_10LX, UTM_30LX, LidarModel
from hal.hokuyo.driver import HokuyoDriver
from hal.lidar import VALID, Link, RawScan
from tests.hal.hokuyo.bench import Bench, on_fake
from tests.rotation import share

LASTS_S = 2.5


@dataclass(frozen=True)
class Case:
    """An order and what may be expected of the driver.

    Attributes:
        word: the fault. order: its parameters in TOML. lasts: False for faults that happen once.
        within: seconds after the fault's end in which 40 scans in a row must have come (1 s of streaming).
        lie: the sensor itself says something false with correct sums; ranges and times are not compared.
        late: times may be off by this much while the fault lasts or just after it, in seconds.
        counts: counters of the status that must have risen.
    """

    word: str
    order: str = ""
    lasts: bool = True
    within: float = 1.6
    lie: bool = False
    late: float = 2e-3
    counts: tuple[str, ...] = ()
    models: tuple[LidarModel, ...] = field(default=(UTM_30LX, UST_10LX))


CASES = [
    Case("off", within=9.0, counts=("reconnects",)),
    Case("stuck", within=6.0, counts=("invalid",)),
    Case("garbage", 'on = "scans"', within=4.0, counts=("resyncs",)),
    Case("garbage", 'on = "all"', within=9.0),
    Case("wrong", lie=True),
    Case("slow", "factor = 1.5", within=8.0),
    Case("delayed", "by_s = 0.3", within=3.0, late=0.4),
    Case("intermittent", counts=("missed",)),
    Case("intermittent", 'on = "all"\nshare = 0.3', counts=("missed",)),
    Case("bit_flip", 'part = "data"', within=5.0, counts=("invalid",)),
    Case("bit_flip", 'part = "sum"', within=5.0, counts=("invalid",)),
    Case("bit_flip", 'part = "echo"', within=5.0, counts=("invalid",)),
    Case("bit_flip", 'part = "status"', within=9.0),
    Case("bit_flip", 'part = "stamp"', within=5.0, counts=("invalid",)),
    Case("bit_flip", 'part = "data"\non = "all"\nshare = 0.5', within=5.0, counts=("invalid",)),
    Case("drop_byte", within=5.0, counts=("invalid",)),
    Case("drop_line", within=5.0, counts=("invalid",)),
    Case("duplicate_line", within=5.0, counts=("invalid",)),
    Case("cut_frame", within=5.0),
    Case("cut_frame", "every = 2", within=5.0, counts=("invalid",)),
    Case("alien_reply", within=5.0, counts=("invalid",)),
    Case("alien_reply", 'command = "VV"\nevery = 3', within=1.6, counts=("invalid",)),
    Case("status", "code = 50\ncount = 1", within=3.0, counts=("resyncs",)),
    Case("status", "code = 50", within=9.0, counts=("resyncs",)),
    Case("status", "code = 98", within=3.0),
    Case("status", "code = 21", within=3.0),
    Case("frozen_stamp", within=7.0, counts=("invalid",)),
    Case("stamp_jump", "by_ms = -5000", within=3.0, counts=("clock_resets",)),
    Case("stamp_jump", "by_ms = 5000", within=3.0, counts=("clock_resets",)),
    Case("stamp_jump", "by_ms = 8388608", within=3.0, counts=("clock_resets",)),
    Case("stamp_jump", "by_ms = -200", within=3.0, counts=("clock_resets",)),
    Case("stamp_jump", "by_ms = 300\ncount = 1", within=3.0, counts=("invalid",)),
    Case("wrong_steps", "by = -1", within=5.0, counts=("invalid",)),
    Case("wrong_steps", "by = 2", within=5.0, counts=("invalid",)),
    Case("codes", "value = 65533", lie=True),
    Case("codes", "value = 3", lie=True),
    Case("dark"),
    Case("silence", within=5.0, counts=("resyncs",)),
    Case("stall", within=2.0),
    Case("hangup", within=6.0, counts=("reconnects",)),
    Case("chunks", "piece = 1"),
    Case("chunks", "piece = 64"),
    Case("chunks", "split_end = true\npiece = 0"),
    Case("chunks", "join = 3\npiece = 0", within=3.0, late=0.1),
    Case("inject", lasts=False),
    Case("inject", r'text = "QT\n"', lasts=False, within=4.0, counts=("resyncs",)),
    Case("inject", r'text = "TM0\n"', lasts=False, within=5.0),
    Case("inject", r'text = "MD0000010001000\n"', lasts=False, within=5.0),
    Case("inject", r'text = "RS\n"', lasts=False, within=6.0),
    Case("ignore", 'command = "QT"'),
    Case("no_reply", 'command = "MD"'),
    Case("text_sum"),
    Case("semicolon"),
    Case("dmax"),
    Case("trouble"),
    Case("reset", lasts=False, within=9.0),
    Case("boot_delay"),
    Case("scip1", within=4.0),
    Case("set_clock", lasts=False, within=3.0),
    Case("set_clock", "ms = 0", lasts=False, within=3.0),
    Case("error", lasts=False, within=12.0),
    Case("verify", within=3.0),
    Case("baud", lasts=False, within=12.0, models=(MODELS["URG-04LX"],)),
]


def test_no_fault_is_left_out() -> None:
    assert {case.word for case in CASES} == set(LIDAR)


def judge(bench: Bench, scan: RawScan, late: float) -> None:
    """A scan must be what the sensor measured, when it measured it."""
    assert bench.scene is not None
    truth = bench.scene(0.0).ranges_mm[scan.first_step :]
    bench.scene.starts.pop()
    valid = (truth >= scan.geometry.dmin) & (truth <= bench.scene.model.dmax)
    assert (scan.ranges[2:] == np.where(valid, truth, 0)[2:]).all()
    assert (scan.code[2:] == np.where(valid, VALID, truth)[2:]).all()
    model = bench.scene.model
    true_time = bench.scene.start_of(scan) + model.amin * model.true_period_s / model.ares
    error = abs(scan.t_mono - true_time)
    assert error < max(late, 3.0 * scan.t_sigma), (scan.seq, scan.t_rx, scan.t_mono - true_time, scan.t_sigma)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("case", "model"),
    [
        pytest.param(
            case,
            model,
            marks=pytest.mark.slow if case.order == "piece = 1" and number else share(number, len(case.models)),
        )
        for case in CASES
        for number, model in enumerate(case.models)
    ],
    ids=[
        f"{case.word} {case.order} {model.modl.partition('(')[0].partition('[')[0]}".replace("\n", " ")
        for case in CASES
        for model in case.models
    ],
)
def test_recovers(case: Case, model: LidarModel) -> None:
    async def body(bench: Bench) -> None:
        driver = bench.driver()
        async with bench.running(driver):
            await bench.more(80, 12.0, driver)
            before = vars_of(driver)
            length = LASTS_S if case.lasts else 0.0
            bench.order(f'[[fault]]\nwhat = "{case.word}"\n{case.order}\n' + (f"for = {length}\n" if length else ""))
            await asyncio.sleep(length + 0.01)
            resumed = len(bench.scans)
            await bench.more(40, case.within, driver)
            assert (driver.status.link, driver.status.error) == (Link.STREAMING, None)
            for name in case.counts:
                assert vars_of(driver)[name] > before[name], name
            assert bench.scans[-1].seq >= resumed
            times = np.diff([scan.t_mono for scan in bench.scans])
            assert (times > 0).all()
            assert (np.diff([scan.seq for scan in bench.scans]) > 0).all()
            if not case.lie:
                for scan in bench.scans:
                    judge(bench, scan, case.late)

    on_fake(body, model, device="/dev/ttyUSB7" if model.link == "rs232" else "/dev/fake7")


def vars_of(driver: HokuyoDriver) -> dict[str, int]:
    status = driver.status
    names = ("scans", "missed", "invalid", "resyncs", "reconnects", "clock_resets")
    return {name: getattr(status, name) for name in names}
