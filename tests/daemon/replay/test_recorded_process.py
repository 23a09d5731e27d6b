"""The real process with `--record`: killed at any moment, its recording replays to the poses it published."""

from __future__ import annotations

import json
import subprocess
import sys
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
def test_a_dump_is_asked_for_as_the_page_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of docs/replay.md, to the socket of this daemon, without `modbus.write`."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (ask,) = (line.split()[1:] for line in documented(ROOT / "docs" / "replay.md") if line.startswith("lumiloop dump"))
    link, folder = tmp_path / "lidar", tmp_path / "flight"
    with fake_lidar(link), running(link, "--record", str(folder), "--last", "1") as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        subprocess.run([sys.executable, "-m", "daemon", *ask], check=True, capture_output=True, timeout=60.0)
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
