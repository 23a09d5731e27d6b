"""The lights of a simulated building as another process meets them: a bus on a socket, and a survey file."""

from __future__ import annotations

import asyncio
import json
from contextlib import AsyncExitStack
from pathlib import Path

import numpy as np
import pytest

from daemon.config.survey_loader import read_survey
from hal.bus.i2c import read
from hal.bus.opening import open_bus
from tools.sim.light.scene import Lights
from tools.sim.light.serve import serve_light, write_plan
from tools.sim.run import main
from tools.sim.scene import Scenario, SimulatedScene


def lit(**lights: object) -> SimulatedScene:
    return SimulatedScene(Scenario("corridor_loop", people=False, lights=Lights(**lights)))  # type: ignore[arg-type]


def test_a_block_is_read_over_the_socket(tmp_path: Path) -> None:
    async def block() -> np.ndarray:
        scene = lit()
        assert scene.light is not None
        async with AsyncExitStack() as stack:
            _, where = await serve_light(scene.light, f"unix:{tmp_path}/i2c", stack)
            bus = await open_bus(where)
            try:
                done = await bus.transfer((read(0x4D, 2222),))
            finally:
                await bus.close()
        return np.frombuffer(done.reads[0], dtype=">u2").astype(float)

    words = asyncio.run(block())
    assert len(words) == 1111
    assert words.max() < 4096
    swing = np.abs(np.fft.rfft(words - words.mean()))
    chips = swing[(np.fft.rfftfreq(1111, 18 / 400e3) > 2000)]  # above all mains harmonics
    assert np.sqrt(np.mean(chips**2)) / np.sqrt(1111 / 2) > 3.0  # LSB: the converter's own noise is 0.5


def test_the_plan_can_be_read_by_the_daemon(tmp_path: Path) -> None:
    scene = lit()
    assert scene.light is not None
    path = tmp_path / "lamps.toml"
    for _ in range(2):
        write_plan(scene.light, path)
    told = read_survey(path)
    assert len(told.lamps) == len(scene.light.ceiling.fixtures)
    assert [(lamp.lamp_id, lamp.code) for lamp in told.lamps] == [
        (f.lamp_id, f.code) for f in scene.light.ceiling.fixtures
    ]
    assert told.receiver.x == pytest.approx(scene.light.ceiling.photodiode.x)
    assert told.receiver.half_fov_rad == pytest.approx(np.radians(60.0))


def test_the_process_says_where_the_light_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    where, survey = f"unix:{tmp_path}/i2c", tmp_path / "lamps.toml"
    arguments = [
        "--building",
        "corridor_loop",
        "--empty",
        "--seconds",
        "0.2",
        "--light",
        where,
        "--survey",
        str(survey),
    ]
    assert main([*arguments, "--pty", str(tmp_path / "lidar")]) == 0
    first = json.loads(capsys.readouterr().out.splitlines()[0])
    assert first["light"] == where
    assert first["lamps"] == len(read_survey(survey).lamps)


def test_a_log_has_no_lamps(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--log", str(tmp_path / "x.clf"), "--light", "unix:/tmp/none"]) == 2
    assert "a log has no lamps" in capsys.readouterr().err


def test_without_a_survey_the_photodiode_sits_where_a_daemon_takes_it_to_be() -> None:
    scene = lit(survey=False)
    assert scene.light is not None
    assert not scene.light.survey.lamps
    assert (scene.light.ceiling.photodiode.x, scene.light.ceiling.photodiode.y) == (0.0, 0.0)
