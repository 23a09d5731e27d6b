"""`lumiloop probe`: what a person and a program read, for a sensor, for nothing, and for something else."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import replace

import msgspec
import pytest

from daemon.cli import probe
from daemon.config import endpoints
from daemon.config.schema import Config, PhotodiodeConfig
from hal.bus.i2c import BusOpener
from hal.errors import DeviceMissing, DeviceRefused
from hal.hokuyo.probe import Finding
from hal.photodiode.probe import BusFinding, Chip
from hal.port.port import PortOpener
from tests.daemon.support.room import URG

LIDAR = Finding("/dev/ttyACM0", URG, "SOKUIKI Sensor URG-04LX", "SCIP 2.0", "Sensor works well.")
NOTHING = Finding("/dev/ttyACM1", error=DeviceMissing("/dev/ttyACM1", "no such device", "connect it"))
BUSY = Finding("/dev/ttyS0", error=DeviceRefused("/dev/ttyS0", "busy", "stop the other program"))


BUS = BusFinding(
    "/dev/i2c-1", "bcm2835 (i2c@7e804000)", (Chip(0x48, "ADS1015 or ADS1115"), Chip(0x4D, "MCP3221", True))
)
EMPTY = BusFinding("unix:/run/i2c", "remote")
CLOSED = BusFinding("/dev/i2c-3", error=DeviceRefused("/dev/i2c-3", "permission denied", "add the user to group i2c"))


def run(
    monkeypatch: pytest.MonkeyPatch,
    there: Sequence[Finding] = (),
    named: Sequence[str] = (),
    as_json: bool = False,
    buses: Sequence[BusFinding] = (),
) -> int:
    by_name = {finding.device: finding for finding in there}
    by_bus = {finding.bus: finding for finding in buses}

    async def look(opener: BusOpener, bus: str) -> BusFinding:
        return by_bus[bus]

    monkeypatch.setattr(probe, "probe_bus", look)
    monkeypatch.setattr("hal.bus.i2c_linux.buses", lambda: list(by_bus))

    async def identify(opener: PortOpener, device: str, baud: int) -> Finding:
        return replace(by_name[device], baud=baud)

    monkeypatch.setattr(probe, "identify_at", identify)
    monkeypatch.setattr("hal.hokuyo.discover.candidates", lambda: list(by_name))
    return probe.main(argparse.Namespace(devices=list(named), json=as_json, settings=Config()))


def test_a_lidar_is_described_with_how_to_use_it(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, [LIDAR, BUSY]) == 0
    output = capsys.readouterr().out
    assert "/dev/ttyACM0: URG-04LX, serial H0500000" in output
    assert "use it: lumiloop run --lidar /dev/ttyACM0" in output
    assert "no lidar: /dev/ttyS0: busy (stop the other program)" in output


def test_a_line_is_named_with_its_rate(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    line = replace(LIDAR, device="/tmp/lidar")
    assert run(monkeypatch, [line], named=["/tmp/lidar@19200"]) == 0
    output = capsys.readouterr().out
    assert "/tmp/lidar: URG-04LX" in output
    assert "19200 bit/s" in output
    assert "use it: lumiloop run --lidar /tmp/lidar@19200\n" in output
    assert run(monkeypatch, [line], named=["/tmp/lidar@1234"]) == 1
    assert "line rate of 19200, 38400" in capsys.readouterr().err


def test_programs_get_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, [LIDAR, NOTHING], as_json=True) == 0
    lidar, nothing = json.loads(capsys.readouterr().out)
    assert (lidar["model"], lidar["serial"], lidar["beams"]) == ("URG-04LX", "H0500000", 682)
    assert (lidar["from_deg"], lidar["to_deg"]) == (-119.531, 119.883)
    assert lidar["range_m"] == [0.02, 5.6]
    assert nothing == {"device": "/dev/ttyACM1", "problem": "no such device", "remedy": "connect it"}


def test_the_exit_code_says_whether_what_was_named_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, [LIDAR, NOTHING], named=["/dev/ttyACM0"]) == 0
    assert run(monkeypatch, [LIDAR, NOTHING], named=["/dev/ttyACM0", "/dev/ttyACM1"]) == 1
    assert run(monkeypatch, [BUSY]) == 1


def test_nothing_to_look_at_is_said_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, []) == 1
    said = capsys.readouterr().err
    assert "lumiloop probe tcp://" in said
    assert "lumiloop probe unix:" in said
    assert run(monkeypatch, [], as_json=True) == 1
    assert json.loads(capsys.readouterr().out) == []


def test_converters_are_listed_with_the_keys_that_use_them(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, buses=[BUS, CLOSED]) == 0
    output = capsys.readouterr().out
    assert "/dev/i2c-1: bcm2835 (i2c@7e804000)\n  0x48: ADS1015 or ADS1115 (levels only" in output
    assert 'use it: photodiode.bus = "/dev/i2c-1", photodiode.converter = "mcp3221@0x4d"\n' in output
    assert 'use it: photodiode.level = "ads1115@0x48/0"\n' in output
    assert "/dev/i2c-3: permission denied (add the user to group i2c)" in output
    keys = {"bus": "/dev/i2c-1", "converter": "mcp3221@0x4d", "level": "ads1115@0x48/0"}
    assert msgspec.convert(keys, PhotodiodeConfig).fitted, "what is said can be used"


def test_a_bus_without_a_converter_is_a_failure_if_it_was_named(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, [LIDAR], buses=[EMPTY]) == 0
    assert run(monkeypatch, [LIDAR], named=["/dev/ttyACM0", "unix:/run/i2c"], buses=[EMPTY]) == 1
    assert run(monkeypatch, named=["/dev/i2c-1"], buses=[BUS]) == 0


def test_programs_get_buses_as_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, as_json=True, buses=[BUS, CLOSED]) == 0
    bus, closed = json.loads(capsys.readouterr().out)
    assert bus["chips"][1] == {"address": 0x4D, "name": "MCP3221", "usable": True}
    assert (closed["bus"], closed["problem"]) == ("/dev/i2c-3", "permission denied")


@pytest.mark.parametrize(
    ("device", "bus"),
    [("/dev/i2c-0", True), ("adapter:CP2112", True), ("unix:/x", True), ("i2c+tcp://h:1", True),
     ("/dev/ttyACM0", False), ("tcp://192.168.0.10:10940", False)],
)  # fmt: skip
def test_names_of_buses(device: str, bus: bool) -> None:
    assert endpoints.is_bus(device) is bus
