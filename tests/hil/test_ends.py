"""The device suite on fakes in other processes, and where a device is missing."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

from tests.hil.programs import ROOT, served_lidar, served_receiver
from tools.sim.ports import free_port

ON_DEVICES = 8
"""Tests of the lidar that need no minutes, and the probe."""


def words_of(tmp_path: Path, *options: str, only: str = "not system") -> list[str]:
    """The command."""
    words = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/hil", "-m", only]
    return [*words, "--ignore=tests/hil/test_ends.py", "--hil-report", str(tmp_path / "report"), *options]


def results_of(tmp_path: Path) -> dict[str, Any]:
    """What came of it, by name."""
    file = tmp_path / "report" / "results.json"
    return {one["name"]: one for one in json.loads(file.read_text())["results"]} if file.exists() else {}


def suite(tmp_path: Path, *options: str) -> tuple[int, str, dict[str, Any]]:
    """Run it as a person does: exit code, output, results by name."""
    done = subprocess.run(words_of(tmp_path, *options), cwd=ROOT, capture_output=True, text=True, timeout=250)
    return done.returncode, done.stdout + done.stderr, results_of(tmp_path)


@pytest.mark.system
@pytest.mark.realtime
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


def test_a_device_that_is_not_there_is_said_once_and_no_other_test_of_it_is_run(tmp_path: Path) -> None:
    """In the reports, too: one failure with its remedy; what was not run says for what reason."""
    missing = ["--lidar", "/dev/ttyNOPE", "--adc", "/dev/i2c-NOPE@0x4d", "--have", "light"]
    code, said, results = suite(tmp_path, *missing, "-k", "lidar or photodiode")
    assert (code, said.count("ERROR at setup")) == (1, 2), said
    listed = said.partition(" short test summary ")[0]  # that repeats as much as the terminal is wide
    for option, problem, remedy in (
        ("lidar", "/dev/ttyNOPE: no such device", "connect the sensor"),
        ("adc", "/dev/i2c-NOPE: no such bus", "enable I2C"),
    ):
        (failed,) = [one for one in results.values() if one["said"].startswith(f"--{option}=/dev/")]
        assert f"no test of it is run: {problem} ({remedy}" in failed["said"]
        assert sum(one["skipped"] == f"not run: {problem}" for one in results.values()) >= 2
        assert listed.count(remedy) == 1, said
    root = ElementTree.parse(tmp_path / "report" / "junit.xml").getroot()
    assert root.get("failures") == "2"
    assert "not run: /dev/ttyNOPE: no such device" in {case.get("message") for case in root.iter("skipped")}
    assert "not run: /dev/ttyNOPE: no such device" in (tmp_path / "report" / "report.html").read_text()
