"""A recorded run with lights, replayed: blocks, survey and sample clock come back, poses the same to the last bit."""

import asyncio
import itertools
import json
import re
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest
from msgspec.structs import replace

from daemon.app import Daemon
from daemon.cli import parser
from daemon.commissioning.teach_drive import read_drive
from daemon.config.loader import dump
from daemon.config.residual_file import write_residuals
from daemon.config.schema import Config, Mount
from daemon.config.survey_loader import write_survey
from daemon.devices.light_setup import RESIDUALS, Lights, from_header
from daemon.recording.recorder import Recorder, decode_cycle
from daemon.replay.recorded_inputs import Given, lights_for
from daemon.replay.sources import open_log
from daemon.runtime.budget import FixedBudget
from daemon.system import console
from estimator.cdma.air_interface import PROFILE_A
from estimator.measurements import Limits
from hal.clock import run_virtual
from hal.odometry import RawOdometry
from hal.replay.recording import Kind, open_recording, pack_frame, pack_head
from hal.replay.report import LogReport
from tests.daemon.replay.test_recorded_run import assert_the_same
from tests.daemon.scenarios.test_lights import LIDAR, Bench, decoded, settings
from tests.daemon.scenarios.test_residual_maps import even_map
from tests.daemon.support.light_room import BUS, SURVEY
from tests.daemon.support.whole_daemon import during


class UnevenBudget(FixedBudget):
    """Caps that change from cycle to cycle, as measured ones do."""

    def __init__(self) -> None:
        super().__init__()
        self._caps = itertools.cycle(
            [Limits(50, 100_000, True, 129), Limits(3, 120, False, 4), Limits(7, 333, True, 40)]
        )

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        return next(self._caps)


class Recorded(Bench):
    """The bench with a recorder, and wheels that turn."""

    def __init__(self, folder: Path, lidar: bool, lights: Lights) -> None:
        self.folder = folder
        super().__init__(lidar=lidar, lights=lights)

    def make(self) -> Daemon:
        config = settings(self.lidar, True)
        self.recorder = Recorder(self.folder, config, self.world.clock, self.lights)
        self.world.make_budget = UnevenBudget
        return Daemon(config, self.world, self.recorder)

    async def drive(self, seconds: float) -> None:
        """Odometry at 33 Hz, in step with nothing."""
        put = self.recorder.on_odometry(self.daemon.cycle.inbox.put_odometry)
        for _ in range(round(seconds / 0.03)):
            await asyncio.sleep(0.03)
            t = self.loop.time()
            put(RawOdometry(t, t - 0.004, 0.02 * (t - 100.0), 0.0, 0.01 * (t - 100.0)))


def record(
    folder: Path, scenario: Callable[[Recorded], Awaitable[None]], lidar: bool, lights: Lights | None = None
) -> Recorded:
    async def go() -> Recorded:
        bench = Recorded(folder, lidar, lights or Lights(SURVEY, PROFILE_A, 12.5))
        await during(bench.daemon, scenario(bench))
        return bench

    return run_virtual(go(), start=100.0)


def replay(folder: Path, out: Path, *options: str) -> dict[str, dict[str, object]]:
    assert parser.main(["replay", str(folder), "--out", str(out), *options]) == console.OK
    summary: dict[str, dict[str, object]] = json.loads((out / "summary.json").read_text())
    return summary


async def calm(bench: Recorded) -> None:
    await bench.until(decoded, 6.0)
    await bench.drive(3.0)


async def eventful(bench: Recorded) -> None:
    """Stalls, damaged words, the adapter unplugged, the lidar unplugged, other lamps."""
    await calm(bench)
    bench.order("what = 'stall'; us = 300; every = 3; for = 1.0")
    bench.order("what = 'shift'; every = 7; for = 1.0")
    await bench.drive(1.5)
    bench.order("what = 'gone'; for = 1.0")
    await bench.drive(2.5)
    bench.opener.unplug(LIDAR)
    await bench.drive(1.0)
    bench.opener.plug(LIDAR, bench.device)
    bench.source.under((5, 17, 60))
    await bench.drive(3.0)


@pytest.mark.parametrize(("scenario", "lidar"), [(calm, False), (eventful, True)])
def test_the_replay_gives_the_same_poses_to_the_last_bit(
    tmp_path: Path, scenario: Callable[[Recorded], Awaitable[None]], lidar: bool
) -> None:
    bench = record(tmp_path / "rec", scenario, lidar)
    summary = replay(tmp_path / "rec", tmp_path / "out")
    assert_the_same(summary, bench.daemon.cycle.cycles)
    assert summary["counts"]["blocks"] == bench.daemon.adc.status.blocks > 50


def test_the_head_keeps_what_the_estimator_was_told(tmp_path: Path) -> None:
    bench = record(tmp_path, calm, lidar=False)
    recording = open_recording(tmp_path)
    assert from_header(recording.header) == bench.lights
    frames = list(recording.frames(LogReport()))
    blocks = [frame for frame in frames if frame.kind == Kind.SAMPLES]
    assert len(blocks) == bench.daemon.adc.status.blocks
    cycles = [decode_cycle(frame.payload) for frame in frames if frame.kind == Kind.CYCLE]
    assert {cycle.codes for cycle in cycles} == {129, 4, 40, None}
    assert cycles[-1].samples == bench.daemon.cycle.blocks


def test_a_block_that_is_missing_is_noticed(tmp_path: Path) -> None:
    record(tmp_path / "rec", calm, lidar=True)
    (segment,) = (tmp_path / "rec").rglob("*.lumirec")
    recording = open_recording(tmp_path / "rec")
    frames = list(recording.frames(LogReport()))
    lost = [index for index, frame in enumerate(frames) if frame.kind == Kind.SAMPLES][40]
    kept = frames[:lost] + frames[lost + 1 :]
    packed = b"".join(pack_frame(frame.kind, frame.channel, frame.t_mono, frame.payload) for frame in kept)
    segment.write_bytes(pack_head(recording.header) + packed)
    summary = replay(tmp_path / "rec", tmp_path / "out")
    assert re.search(r"used block 4[01], recorded is 4[12]", str(summary["recorded_run"]["first_difference"]))


def test_another_survey_may_be_asked_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record(tmp_path / "rec", calm, lidar=True)
    missing = tmp_path / "nowhere.toml"
    arguments = ["replay", str(tmp_path / "rec"), "--out", str(tmp_path / "out"), "--set", f"lights.survey={missing}"]
    assert parser.main(arguments) == console.FAILED
    assert "no such survey" in capsys.readouterr().err
    without = replay(tmp_path / "rec", tmp_path / "out", "--set", "photodiode.bus=")
    assert without["counts"]["poses"]


def test_the_recorded_sample_clock_counts_whatever_else_is_asked_for(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", calm, lidar=False)
    write_survey(tmp_path / "lights.toml", SURVEY)
    (tmp_path / "robot.toml").write_text(dump(settings(False, True)) + "\n")
    survey = f"lights.survey={tmp_path / 'lights.toml'}"
    for options in (["--set", survey], ["--config", str(tmp_path / "robot.toml"), "--set", survey]):
        summary = replay(tmp_path / "rec", tmp_path / "out", *options)
        assert summary["recorded_run"]["cycles"] == bench.daemon.cycle.cycles
        assert summary["recorded_run"]["differ"] == 0, summary["recorded_run"]


def test_the_sample_clock_of_another_air_interface_is_another(tmp_path: Path) -> None:
    record(tmp_path / "rec", calm, lidar=False)
    source = open_log(tmp_path / "rec")
    for profile, clock in (("A", 12.5), ("B", None)):
        config = settings(False, True)
        used = replace(config, photodiode=replace(config.photodiode, profile=profile))
        lights = lights_for(source, used, Given(True))
        assert lights is not None
        assert (lights.profile.name, lights.clock_ppm) == (profile, clock)


def test_a_drive_knows_its_configuration_and_its_air_interface(tmp_path: Path) -> None:
    record(tmp_path, calm, lidar=True)
    drive = read_drive(open_log(tmp_path), Config(), Given())
    assert (drive.config, drive.profile) == (settings(True, True), PROFILE_A)
    turned = replace(settings(True, True), lidar=replace(drive.config.lidar, mount=Mount(x=0.2, yaw=90.0)))
    assert read_drive(open_log(tmp_path), turned, Given(keys=("lidar.mount",))).mount == pytest.approx(
        (0.2, 0.0, np.pi / 2)
    )


def test_a_residual_map_that_went_missing_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_residuals(tmp_path / "map.npz", even_map(SURVEY), SURVEY)
    lights = Lights(SURVEY, PROFILE_A, 12.5, (tmp_path / "map.npz").read_bytes())
    record(tmp_path / "rec", calm, lidar=False, lights=lights)
    (kept,) = (tmp_path / "rec").rglob(RESIDUALS)
    whole = replay(tmp_path / "rec", tmp_path / "out")
    assert whole["recorded_run"]["differ"] == 0
    assert "residual map" not in capsys.readouterr().err
    kept.unlink()
    replay(tmp_path / "rec", tmp_path / "out")
    assert f"its residual map is missing in {kept.parent} or damaged" in capsys.readouterr().err


def test_lights_of_another_version_are_refused_by_name() -> None:
    header = Lights(SURVEY, PROFILE_A, 3.0).header()
    assert from_header(msgspec.json.decode(msgspec.json.encode(header))) == Lights(SURVEY, PROFILE_A, 3.0)
    assert from_header({}) is None
    for broken in ({"survey": {"lamps": 3}}, {**header["lights"], "profile": "Q"}, 7):
        with pytest.raises(ValueError, match="of another version"):
            from_header({"lights": broken})


def test_the_bus_is_named_in_the_configuration_that_is_kept(tmp_path: Path) -> None:
    record(tmp_path, calm, lidar=False)
    assert open_recording(tmp_path).header["config"]["photodiode"]["bus"] == BUS
