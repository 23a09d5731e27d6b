"""The virtual bench, but for the computer it emulates: needs, wires, report; and all of it, slowly."""

from __future__ import annotations

import json
import math
import os
import struct
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from tools.bench.vm import bench, image, places
from tools.bench.vm.guest import agent
from tools.bench.vm.machine import Ports, _words
from tools.bench.vm.report import Result, junit, page, regressions, write
from tools.bench.vm.scenarios import PARTS, SCENARIOS, WRITTEN

ROOT = Path(__file__).parents[2]
GOOD = Result("boots", "Debian boots", True, 20.0, "up after 20 s")
BAD = Result("drives", "A lap", False, 31.0, "0.300 m\nlog <of> the daemon")


def test_every_scenario_is_in_the_list_once_and_has_a_title() -> None:
    assert len(SCENARIOS) == len(set(SCENARIOS)) == len(WRITTEN)
    assert len(SCENARIOS) >= 25
    assert all(one.__doc__ and len(one.__doc__.splitlines()) == 1 for one in SCENARIOS)
    assert [part.__name__.rpartition("_")[2] for part in PARTS] == ["system", "devices", "process"]


def test_what_is_missing_is_said_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places.shutil, "which", lambda tool, path: None if tool.startswith("qemu") else "/usr/bin/it")
    assert places.missing() == "missing programs: apt-get install --no-install-recommends qemu-system-x86"
    monkeypatch.setattr(places.shutil, "which", lambda tool, path: "/usr/bin/it")
    monkeypatch.setattr(places.os, "geteuid", lambda: 1000)
    assert "run it once as root" in places.missing()
    assert places.missing(build=False) == ""


def test_a_machine_without_qemu_is_told_so_and_nothing_is_left(tmp_path: Path) -> None:
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path), "PATH": str(tmp_path)}
    command = [sys.executable, "-m", "tools.bench.vm", "--out", str(tmp_path / "out")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    assert done.returncode == 2
    assert "missing programs: apt-get install" in done.stdout
    assert list(tmp_path.iterdir()) == []


def test_a_folder_left_by_a_killed_process_is_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(places, "MEMORY", tmp_path)
    left, running = tmp_path / "some-999999999", tmp_path / f"some-{os.getppid()}"
    left.mkdir()
    running.mkdir()
    with places.workspace("some", 1000) as folder:
        assert folder == tmp_path / f"some-{os.getpid()}"
        (folder / "file").touch()
    assert list(tmp_path.iterdir()) == [running]


def test_the_image_depends_on_what_is_in_it_and_on_nothing_else() -> None:
    key = image.digest(ROOT / "systemd")
    assert key == image.digest(ROOT / "systemd")
    assert key != image.digest(ROOT / "systemd", ROOT / "pyproject.toml")
    assert key != image.digest(ROOT / "systemd", extra="another recipe")


def test_the_disk_is_never_written_to_and_only_loopback_is_listened_on(tmp_path: Path) -> None:
    words = _words(image.Image(tmp_path), tmp_path, Ports(1, 2, 3))
    assert any("snapshot=on" in word for word in words)
    forwards = [part for word in words for part in word.split(",") if part.startswith("hostfwd=")]
    assert len(forwards) == 3
    assert all(":127.0.0.1:" in forward for forward in forwards)


def test_a_transaction_of_the_adapter_is_understood() -> None:
    data = struct.pack("=Ii4H4H", 7, 2, 0x48, 0, 3, 0, 0x4D, agent.READ, 512, 0) + b"\x01\x83\x05"
    assert agent.transaction(data) == (7, [(0x48, b"\x01\x83\x05", 0), (0x4D, b"", 512)])


def test_orders_are_carried_out_and_answered(tmp_path: Path) -> None:
    assert agent.obey({"run": ["sh", "-c", "echo here; exit 3"]}) == {"code": 3, "out": "here\n"}
    assert agent.obey({"run": ["sleep", "9"], "seconds": 0.05})["code"] == 127
    assert agent.obey({"write": str(tmp_path / "a/b"), "text": "c"})["code"] == 0
    assert (tmp_path / "a/b").read_text() == "c"
    assert agent.obey({"fly": True})["code"] == 126


def test_a_line_that_nobody_reads_loses_what_is_sent_and_stops_nobody() -> None:
    source, feed = os.pipe()
    end, sink = os.pipe()
    os.set_blocking(sink, False)
    try:
        os.write(feed, b"first")
        agent.hand_over(source, sink)
        assert os.read(end, 16) == b"first"
        while True:
            try:
                os.write(sink, bytes(4096))
            except BlockingIOError:
                break
        os.write(feed, b"lost")
        agent.hand_over(source, sink)
        os.close(feed)
        with pytest.raises(OSError, match="hung up"):
            agent.hand_over(source, sink)
    finally:
        for one in (source, end, sink):
            os.close(one)


def test_a_pose_is_compared_where_the_map_begins() -> None:
    x, y, yaw = bench.inverse_then((1.0, 2.0, math.pi / 2), (1.0, 3.0, math.pi))
    assert (x, y, yaw) == pytest.approx((1.0, 0.0, math.pi / 2))


def test_the_truth_is_interpolated() -> None:
    ears = bench.Ears()
    ears.truth.extend([(1.0, (0.0, 0.0, 3.1)), (2.0, (1.0, 2.0, -3.1))])
    pose = ears.true_pose(1.5)
    assert pose == pytest.approx((0.5, 1.0, math.pi), abs=1e-9)
    assert ears.true_pose(0.5) is None


def test_the_report_names_what_failed(tmp_path: Path) -> None:
    suite = ElementTree.fromstring(junit([GOOD, BAD]))
    assert (suite.get("tests"), suite.get("failures")) == ("2", "1")
    assert [case.get("name") for case in suite if case.find("failure") is not None] == ["drives"]
    text = page([GOOD, BAD], {"version": "1"}, [])
    assert "1 of 2 scenarios passed" in text
    assert "log &lt;of&gt; the daemon" in text
    assert write(tmp_path, [GOOD, BAD], {}, None) == []
    assert json.loads((tmp_path / "results.json").read_text())["results"][0]["name"] == "boots"


def test_a_run_is_compared_with_another(tmp_path: Path) -> None:
    slow = Result("boots", "Debian boots", True, 60.0, "up after 60 s")
    fine = Result("drives", "A lap", True, 31.0, "")
    assert regressions([slow, BAD], [GOOD, fine]) == ["boots takes 60 s, 20 s then", "drives passed then"]
    assert regressions([GOOD, fine], [GOOD, BAD]) == []
    write(tmp_path, [GOOD, fine], {}, None)
    assert write(tmp_path / "now", [slow, BAD], {}, tmp_path / "results.json") == [
        "boots takes 60 s, 20 s then",
        "drives passed then",
    ]


@pytest.mark.system
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_package_in_an_emulated_computer(tmp_path: Path) -> None:
    if reason := places.missing():
        pytest.skip(reason)
    command = [sys.executable, "-m", "tools.bench.vm", "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
