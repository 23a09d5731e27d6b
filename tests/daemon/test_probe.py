"""`lumiloop probe`: what a person and a program read, for a sensor, for nothing, and for something else."""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence

import pytest

from daemon import probe
from daemon.config import Config
from hal.errors import DeviceMissing, DeviceRefused
from hal.port import PortOpener
from hal.probe import Finding
from tests.daemon.room import URG

LIDAR = Finding("/dev/ttyACM0", URG, "SOKUIKI Sensor URG-04LX", "SCIP 2.0", "Sensor works well.")
NOTHING = Finding("/dev/ttyACM1", error=DeviceMissing("/dev/ttyACM1", "no such device", "plug it in"))
BUSY = Finding("/dev/ttyS0", error=DeviceRefused("/dev/ttyS0", "busy", "stop the other program"))


def run(
    monkeypatch: pytest.MonkeyPatch, there: Sequence[Finding], named: Sequence[str] = (), as_json: bool = False
) -> int:
    by_name = {finding.device: finding for finding in there}

    async def identify(opener: PortOpener, device: str) -> Finding:
        return by_name[device]

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


def test_programs_get_json(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(monkeypatch, [LIDAR, NOTHING], as_json=True) == 0
    lidar, nothing = json.loads(capsys.readouterr().out)
    assert (lidar["model"], lidar["serial"], lidar["beams"]) == ("URG-04LX", "H0500000", 682)
    assert (lidar["from_deg"], lidar["to_deg"]) == (-119.531, 119.883)
    assert lidar["range_m"] == [0.02, 5.6]
    assert nothing == {"device": "/dev/ttyACM1", "problem": "no such device", "remedy": "plug it in"}


def test_the_exit_code_says_whether_what_was_named_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    assert run(monkeypatch, [LIDAR, NOTHING], named=["/dev/ttyACM0"]) == 0
    assert run(monkeypatch, [LIDAR, NOTHING], named=["/dev/ttyACM0", "/dev/ttyACM1"]) == 1
    assert run(monkeypatch, [BUSY]) == 1


def test_nothing_to_look_at_is_said_with_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(monkeypatch, []) == 1
    assert "lumiloop probe tcp://" in capsys.readouterr().err
    assert run(monkeypatch, [], as_json=True) == 1
    assert json.loads(capsys.readouterr().out) == []
