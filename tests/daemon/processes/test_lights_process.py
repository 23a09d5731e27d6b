"""The real program with a photodiode: its bus on a unix socket, real time, the status a person reads, what it keeps."""

import asyncio
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from daemon.config.survey_loader import write_survey
from daemon.devices.light_setup import Lights
from daemon.devices.sample_clock import FILE
from daemon.health.faults import Fault
from daemon.publish.modbus import registers
from daemon.runtime.warmup import load
from estimator.cdma.air_interface import PROFILE_A
from hal.bus.i2c_server import BusServer
from hal.clock import SystemClock
from tests.daemon.processes.test_process import ROOT, Running, running
from tests.daemon.support.light_room import BUS, CODES, SURVEY, Lit, plugged

pytestmark = [pytest.mark.realtime, pytest.mark.system]

SCL_ERROR = 2.0e-3


class Served:
    """A fake converter under lamps, served on a unix socket by a thread of this process."""

    def __init__(self, where: str) -> None:
        self._where = where
        self._ready, self._stop = threading.Event(), asyncio.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)
        self._thread.start()
        assert self._ready.wait(10.0)

    async def _serve(self) -> None:
        self._loop = asyncio.get_running_loop()
        clock = SystemClock()
        buses, device = plugged(clock, Lit())
        device.bus.scl_error = SCL_ERROR
        server = BusServer(buses, BUS, clock)
        await server.listen(self._where)
        self._ready.set()
        await self._stop.wait()
        await server.close()

    def close(self) -> None:
        self._loop.call_soon_threadsafe(self._stop.set)
        self._thread.join(10.0)


@contextmanager
def served(where: str) -> Iterator[Served]:
    server = Served(where)
    try:
        yield server
    finally:
        server.close()


@contextmanager
def daemon(folder: Path) -> Iterator[Running]:
    survey = folder / "lights.toml"
    if not survey.exists():
        write_survey(survey, SURVEY)
    keys = ["--set", f"photodiode.bus=unix:{folder / 'bus'}", "--set", f"lights.survey={survey}"]
    os.environ["XDG_STATE_HOME"] = str(folder / "state")
    try:
        with running(Path("none"), *keys) as started:
            yield started
    finally:
        del os.environ["XDG_STATE_HOME"]


def status(modbus: int, *options: str) -> str:
    command = [sys.executable, "-m", "daemon", "status", f"127.0.0.1:{modbus}", *options]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=30.0).stdout


def test_lights_alone_over_a_remote_bus(tmp_path: Path) -> None:
    load(Lights(SURVEY, PROFILE_A))
    where = f"unix:{tmp_path / 'bus'}"
    with daemon(tmp_path) as started:
        assert started.until(60.0, "fault", Fault.ADC_BUS_MISSING)["links"] == 0, "the bus is not served yet"
        with served(where):
            reading = started.until(60.0, "links", len(CODES))
            assert registers.decode_bits(registers.DEVICES, reading["devices"]) == {
                "lidar_fitted": False, "lidar_ok": False, "adc_fitted": True, "adc_ok": True,
                "odometry_fitted": False, "odometry_ok": False,
            }  # fmt: skip
            _status_shows_the_links(started.modbus)
        gone = time.monotonic()
        started.until(10.0, "fault", Fault.ADC_BUS_MISSING)
        assert time.monotonic() - gone < 8.0
        with served(where):
            started.until(30.0, "links", len(CODES))
        code, said, _ = started.stop()
    assert code == 0
    assert "Traceback" not in said
    (ppm,) = json.loads((tmp_path / "state" / "lumiloop" / FILE).read_text()).values()
    assert ppm == pytest.approx(-1e6 * SCL_ERROR, abs=200.0)


def _status_shows_the_links(modbus: int) -> None:
    shown = status(modbus)
    for code in CODES:
        assert f" {code} " in shown
    assert "light fix" in shown
    assert "devices    adc ok" in shown
    lights = json.loads(status(modbus, "--json"))["lights"]
    assert {link["code"] for link in lights["links"]} >= set(CODES)
    strengths = [link["strength_a"] for link in lights["links"]]
    assert strengths == sorted(strengths, reverse=True)
    assert lights["sample_clock_ppm"] == pytest.approx(-1e6 * SCL_ERROR, abs=200.0)


def test_a_bad_survey_stops_the_start_with_its_place(tmp_path: Path) -> None:
    (tmp_path / "lights.toml").write_text("lamp = [\n  { lamp_id = 1, code = 5, x = 0.0, y = 0.0, z = 'high' },\n]\n")
    with daemon(tmp_path) as started:
        _, said = started.process.communicate(timeout=30.0)
    assert started.process.returncode == 2
    assert 'lights.toml:2: lamp 1: `z` = "high": expected a number' in said
    assert "Traceback" not in said
