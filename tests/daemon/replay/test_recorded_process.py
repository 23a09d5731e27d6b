"""The real process with `--record`: killed at any moment, its recording replays to the poses it published."""

from __future__ import annotations

import json
import re
import shlex
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.diagnosis.recorded_spans import spans
from daemon.snapshot import State
from daemon.system import console
from tests.daemon.processes.test_process import ROOT, fake_lidar, running
from tests.taps.documented import documented


@pytest.mark.realtime
@pytest.mark.system
def test_a_killed_run_is_repeated_to_the_last_bit(tmp_path: Path) -> None:
    """Measured budgets, a worker thread, a real tty: nothing of that may matter to the replay."""
    link, folder = tmp_path / "lidar", tmp_path / "recordings"
    with fake_lidar(link), running(link, "--record", str(folder)) as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        time.sleep(3.0)
        daemon.process.kill()
        daemon.process.wait(10.0)
    assert parser.main(["replay", str(folder), "--out", str(tmp_path / "out")]) == console.OK
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    compared = summary["recorded_run"]
    assert compared["differ"] == 0, compared["first_difference"]
    assert compared["cycles"] > 3.0 / 0.025 / 4
    assert summary["config"]["lidar"]["device"] == str(link)


@pytest.mark.realtime
@pytest.mark.system
def test_the_ring_of_a_killed_run_is_a_dump_after_the_next_start_and_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a second of the run is lost at most."""
    link, folder = tmp_path / "lidar", tmp_path / "ring"
    with fake_lidar(link), running(link, "--record", str(folder), "--last", "1") as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        time.sleep(33.0)  # past the first state
        killed = time.time()
        daemon.process.kill()
        daemon.process.wait(10.0)
    with fake_lidar(link), running(link, "--record", str(folder), "--last", "1") as daemon:
        daemon.until(30.0, "state", State.TRACKING)
    (dump,) = folder.glob("dump-*-died")
    assert spans(dump)[0].end > killed - 0.5 - 0.1
    state = sorted(dump.glob("*.lumistate"))[0]
    for segment in dump.glob("*.lumirec"):
        if segment.stem < state.stem:
            segment.unlink()
    assert parser.main(["replay", str(dump), "--out", str(tmp_path / "out")]) == console.OK
    compared = json.loads((tmp_path / "out" / "summary.json").read_text())["recorded_run"]
    assert compared["differ"] == 0, compared["first_difference"]
    assert compared["cycles"] > 20


@pytest.mark.realtime
@pytest.mark.system
@pytest.mark.skipif(shutil.which("mbpoll") is None, reason="mbpoll is not installed (Debian: apt-get install mbpoll)")
def test_a_dump_is_asked_for_as_the_page_says(tmp_path: Path) -> None:
    """The lines of docs/replay.md, to this daemon's port."""
    ask, read = (shlex.split(line) for line in documented(ROOT / "docs" / "replay.md") if line.startswith("mbpoll"))
    link, folder = tmp_path / "lidar", tmp_path / "flight"
    options = ["--record", str(folder), "--last", "1", "--set", "modbus.write=true"]
    with fake_lidar(link), running(link, *options) as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        for words in (ask, read):
            words[words.index("-p") + 1] = str(daemon.modbus)
        subprocess.run(ask, check=True, capture_output=True, timeout=10.0)
        end, said = time.monotonic() + 20.0, ""
        while re.findall(r"\[100[89]\]:\s*(\d+)", said) != ["1", "2"]:
            assert time.monotonic() < end, said
            said = subprocess.run(read, check=True, capture_output=True, text=True, timeout=10.0).stdout
    assert len(list(folder.glob("dump-*-asked"))) == 1


@pytest.mark.realtime
def test_a_folder_that_cannot_be_written_costs_the_recording_and_no_more(tmp_path: Path) -> None:
    place = tmp_path / "file"
    place.write_text("")
    with fake_lidar(tmp_path / "lidar"), running(tmp_path / "lidar", "--record", str(place)) as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        daemon.until(10.0, "fault", 402)
        code, said, _ = daemon.stop()
    assert code == console.OK
    assert "has stopped: Not a directory" in said
