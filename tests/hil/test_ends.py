"""The suite itself: the same bodies on a tty and over the network, and what it says where it cannot."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.hil.ends import AdcEnd, operator_for
from tests.hil.programs import ROOT, free_port, program, served_lidar, served_receiver

ON_DEVICES = 8
"""Tests of the lidar that need no minutes, and the probe."""


def suite(tmp_path: Path, *options: str, only: str = "not system") -> tuple[int, str, Any]:
    """Run it as a person does: exit code, output, results by name."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/hil", "-m", only]
    ignored = ["--ignore=tests/hil/test_ends.py", "--hil-report", str(tmp_path / "report")]
    done = subprocess.run([*words, *ignored, *options], cwd=ROOT, capture_output=True, text=True, timeout=250)
    file = tmp_path / "report" / "results.json"
    told = json.loads(file.read_text())["results"] if file.exists() else []
    return done.returncode, done.stdout + done.stderr, {one["name"]: one for one in told}


@pytest.mark.system
@pytest.mark.parametrize("line", ["tty", "tcp"])
def test_the_same_bodies_pass_on_a_tty_and_over_tcp(line: str, tmp_path: Path) -> None:
    """Fakes in other processes, met through the kernel; the fake's control socket is the operator."""
    where = () if line == "tty" else ("--tcp", f"127.0.0.1:{free_port()}")
    with served_lidar(tmp_path, *where) as lidar:
        device = str(tmp_path / "lidar") if line == "tty" else f"tcp://{where[1]}"
        named = ["--lidar", device, "--operator", str(tmp_path / "lidar.control")]
        code, said, results = suite(tmp_path, *named, "-k", "lidar or probe")
        assert lidar.folder == tmp_path
    assert code == 0, said
    assert len(results) == ON_DEVICES
    assert {one["name"] for one in results.values() if one["skipped"]} == set(), said
    assert ElementTree.parse(tmp_path / "report" / "junit.xml").getroot().get("failures") == "0"
    assert "<svg" in (tmp_path / "report" / "report.html").read_text()


@pytest.mark.system
def test_the_same_bodies_pass_on_a_remote_bus(tmp_path: Path) -> None:
    """The converter in another process."""
    with served_receiver(tmp_path) as adc:
        named = ["--adc", adc, "--have", "light", "--operator", str(tmp_path / "adc.control")]
        code, said, results = suite(tmp_path, *named, "-k", "photodiode")
        assert code == 0, said
        assert not any(one["skipped"] for one in results.values())
        assert {figure["name"] for figure in results["test_photodiode.py::test_in_the_dark"]["figures"]}


def test_what_cannot_be_is_said_or_skipped_with_its_reason(tmp_path: Path) -> None:
    """A device that is not there, and a bench with nobody and nothing at hand."""
    devices = ["--lidar", str(tmp_path / "nothing"), "--adc", f"unix:{tmp_path}/none@0x4d"]
    code, _, results = suite(tmp_path, *devices, "-k", "unplugged or light_levels or who_it_is")
    assert code == 1
    who = results["test_lidar.py::test_says_who_it_is"]
    assert not who["passed"]
    assert "no such device" in who["said"]
    skipped = {name: one["skipped"] for name, one in results.items() if one["skipped"]}
    assert len(skipped) == 3
    assert skipped["test_photodiode.py::test_light_levels"].startswith("needs light on unix:")
    assert "--operator terminal" in skipped["test_lidar.py::test_is_unplugged_and_plugged_in_again"]


@pytest.mark.parametrize("name", ["/dev/i2c-1", "@0x4d", "/dev/i2c-1@4d,", "/dev/i2c-1@"])
def test_a_converter_that_is_named_wrongly(name: str) -> None:
    with pytest.raises(pytest.UsageError, match="as /dev/i2c-1@0x4d"):
        AdcEnd(name)


def test_programs_and_operators_that_are_not_there(tmp_path: Path) -> None:
    with pytest.raises(pytest.UsageError, match="no such program"):
        program(str(tmp_path / "lumiloop"))
    with pytest.raises(pytest.UsageError, match="no socket"):
        operator_for(str(tmp_path / "control"))
    assert operator_for("") is None
    if not _terminal():
        with pytest.raises(pytest.UsageError, match="run it in a terminal"):
            operator_for("terminal")


def _terminal() -> bool:
    try:
        Path("/dev/tty").open("r+b", buffering=0).close()
    except OSError:
        return False
    return True
