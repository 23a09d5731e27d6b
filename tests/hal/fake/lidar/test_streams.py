"""Scans on the wire: ranges, counts, stamps and instants."""

import asyncio
from dataclasses import replace

import numpy as np
import pytest

from hal.fake.lidar.models import MODELS, UST_10LX, UTM_30LX, LidarModel, Unit
from hal.fake.lidar.rotor import EvenRotor, TimetableRotor
from hal.fake.lidar.scan import FakeScan
from tests.hal.fake.bench import Reply, Talk, talking, virtual

PERIOD = UTM_30LX.true_period_s
STILL = replace(UTM_30LX, latency_s=0.0, jitter_s=0.0)


def record(command: str, seconds: float, model: LidarModel = UTM_30LX, unit: Unit | None = None) -> list[Reply]:
    async def scene(talk: Talk) -> list[Reply]:
        talk.say(command + "\n")
        await asyncio.sleep(seconds)
        return talk.replies()

    return virtual(scene, model, unit=unit)


def test_part_of_the_steps() -> None:
    scan = record("MD0100010200001", 0.2)[1]
    assert scan.values() == [1100, 1101, 1102]


@talking()
async def test_countdown_and_end(talk: Talk) -> None:
    talk.say("MD0000108000012;x\n")
    await asyncio.sleep(1.0)
    echoes = [reply.echo for reply in talk.replies()]
    assert (await talk.one("II", 0.1)).pairs["LASR"] == "OFF"
    assert echoes == ["MD0000108000012;x"] + [f"MD00001080000{n:02d};x" for n in range(11, -1, -1)]


def test_cluster_takes_the_nearest_that_is_no_error() -> None:
    ranges = np.full(UTM_30LX.steps, 5000, dtype=np.int32)
    ranges[0:7] = [900, 800, 4, 5, 3, 1, 700]

    async def scene(talk: Talk) -> list[int]:
        talk.say("MD0000000603001\n")
        await asyncio.sleep(0.2)
        return talk.scans()[0].values()

    assert virtual(scene, source=lambda _t: FakeScan(ranges)) == [800, 1, 700]


def test_modes() -> None:
    ranges = np.array([1234, 5432, 30000, 2000], dtype=np.int32)
    scan = FakeScan(
        ranges,
        np.array([1780, 16219, 0, 700], dtype=np.int32),
        np.array([[5432, 0], [0, 0], [0, 0], [2500, 2600]], dtype=np.int32),
        np.array([[900, 0], [0, 0], [0, 0], [80, 90]], dtype=np.int32),
    )
    tiny = replace(MODELS["UST-20LX"], amax=3, afrt=1)

    async def scene(talk: Talk) -> dict[str, Reply]:
        await talk.ask("BM", 0.1)
        out = {}
        for name in ("GD", "GS", "GE", "HD", "HE"):
            out[name] = await talk.one(f"{name}0000000300", 0.3)
        for name in ("MD", "MS", "ME", "ND", "NE"):
            await talk.ask(f"{name}0000000300001", 0.3)
            (out[name],) = talk.scans()
        return out

    got = virtual(scene, tiny, source=lambda _t: scan)
    assert got["MD"].values() == got["GD"].values() == ranges.tolist()
    assert got["MS"].values(2) == got["GS"].values(2) == [1234, 4095, 4095, 2000]
    assert got["ME"].values() == got["GE"].values() == [1234, 1780, 5432, 16219, 30000, 0, 2000, 700]
    nd = [[(1234,), (5432,)], [(5432,)], [(30000,)], [(2000,), (2500,), (2600,)]]
    assert got["ND"].echoes(1) == got["HD"].echoes(1) == nd
    ne = [[(1234, 1780), (5432, 900)], [(5432, 16219)], [(30000, 0)], [(2000, 700), (2500, 80), (2600, 90)]]
    assert got["NE"].echoes(2) == got["HE"].echoes(2) == ne
    assert {reply.status for name, reply in got.items() if name[0] in "GH"} == {"00"}


@talking()
async def test_single_measurement_is_the_latest_complete_one_and_waits_for_the_first(talk: Talk) -> None:
    await asyncio.sleep(1.0)
    await talk.ask("BM", 0.001)
    first = await talk.one("GD0000000000", 0.5)
    again = await talk.one("GD0000000000", 0.5)
    assert first.tick >= 1000.0
    assert 1.01 < first.t < 1.06
    assert [first.values()[0], again.values()[0]] == [1000, 1002]  # the world is asked only for what is wanted
    assert 1000.0 * (1.501 - 2 * PERIOD) < again.tick < 1501.0


def test_stamp_is_the_clock_at_step_0_and_the_scan_leaves_after_the_last_step() -> None:
    fast = replace(STILL, link="ethernet")
    scans = record("MD0000108000000", 1.0, fast)[1:]
    for n, scan in enumerate(scans):
        start = PERIOD * n
        assert scan.tick == int(1e3 * start + 1e-6)
        assert scan.t == pytest.approx(start + PERIOD * 1080 / 1440 + 3372 / 12.5e6, abs=1e-9)


def test_ust_speaks_on_the_ticks_of_its_clock() -> None:
    unit = Unit(clock_ms=5, clock_gain=100e-6)

    async def scene(talk: Talk) -> None:
        talk.say("MD0540054200000\n")
        await asyncio.sleep(0.5)
        for _, scan in enumerate(talk.replies()):
            bytes_s = (len(scan.echo) + 1 + 4 + sum(len(line) + 1 for line in scan.lines) + 1) / 12.5e6
            phase = talk.device.clock.ms(scan.t - bytes_s)
            assert abs(phase - round(phase)) < 1e-3

    virtual(scene, UST_10LX, unit=unit)


def test_two_runs_give_the_same_bytes_and_instants() -> None:
    def run() -> list[tuple[float, bytes]]:
        async def scene(talk: Talk) -> list[tuple[float, bytes]]:
            talk.schedule.load('[[fault]]\nwhat = "bit_flip"\nshare = 0.3\n[[fault]]\nwhat = "drop_byte"\nshare = 0.2')
            talk.say("VV\nMD0000108000000\n")
            await asyncio.sleep(2.0)
            return talk.pieces

        return virtual(scene, unit=Unit(seed=7))

    assert run() == run()


@talking(MODELS["URG-04LX"])
async def test_quit_lets_at_most_the_scan_on_the_line_pass(talk: Talk) -> None:
    talk.say("MD0044072500000\n")
    await asyncio.sleep(5.0)
    assert [reply.status for reply in await talk.ask("QT", 5.0)] == ["99", "00"]


@talking()
async def test_new_parameters_restart_the_stream(talk: Talk) -> None:
    talk.say("MD0000108000000\n")
    await asyncio.sleep(0.2)
    echoes = [reply.echo for reply in await talk.ask("MS0540054200000", 0.2)]
    at = echoes.index("MS0540054200000")
    assert at <= 1
    assert set(echoes[at:]) == {"MS0540054200000"}


@talking()
async def test_queries_are_answered_between_scans(talk: Talk) -> None:
    talk.say("MD0000108000000\n")
    for _ in range(20):
        await asyncio.sleep(0.013)
        talk.say("II\n")
    await asyncio.sleep(0.1)
    echoes = [reply.echo for reply in talk.replies()]
    assert echoes.count("II") == 20
    assert echoes.count("MD0000108000000") > 10


def test_timetable_keeps_the_rhythm_of_a_log() -> None:
    starts = [0.5, 0.6003, 0.6995, 0.9]

    async def scene(talk: Talk) -> list[int]:
        talk.say("MD0000108000000\n")
        await asyncio.sleep(5.0)
        return [scan.tick for scan in talk.scans()]

    ticks = virtual(scene, rotor=lambda _t: TimetableRotor(starts, PERIOD))
    assert ticks == [500, 600, 699, 900]


def test_timetable_must_rise() -> None:
    with pytest.raises(ValueError, match="must rise"):
        TimetableRotor([1.0, 1.0], 0.1)


def test_speed_changes_without_a_jump() -> None:
    rotor = EvenRotor(10.0, 0.1)
    rotor.set_period(10.25, 0.2)
    starts = [rotor.start_of(k) for k in range(6)]
    assert starts == pytest.approx([10.0, 10.1, 10.2, 10.3, 10.5, 10.7])
    assert [rotor.period_of(k) for k in (2, 3)] == [0.1, 0.2]
    assert [rotor.index_after(t) for t in (10.0, 10.05, 10.3, 10.31, 10.5)] == [0, 1, 3, 4, 4]
    assert rotor.start_of(-1) is None


@talking(source=lambda _t: FakeScan(np.zeros(5, dtype=np.int32)))
async def test_source_of_the_wrong_width_is_named(talk: Talk) -> None:
    problems: list[str] = []
    talk.loop.set_exception_handler(lambda _loop, context: problems.append(str(context["exception"])))
    talk.say("MD0000108000000\n")
    await asyncio.sleep(0.1)
    assert "needs (1081,)" in problems[0]


@talking(source=lambda _t: None)
async def test_source_that_has_nothing_to_say(talk: Talk) -> None:
    assert len(await talk.ask("MD0000108000000", 1.0)) == 1


@talking(STILL)
async def test_a_revolution_that_has_begun_is_not_sent(talk: Talk) -> None:
    await asyncio.sleep(10 * PERIOD + 0.001)
    await talk.ask("MD0000108000001", 0.2)
    assert talk.scans()[0].tick == int(1e3 * 11 * PERIOD)
