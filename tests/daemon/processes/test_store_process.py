"""The store in a real process: saved on command and at the stop, loaded at the next start, refused where it must be."""

import struct
import subprocess
import sys
import time
from pathlib import Path
from socket import create_connection

import pytest

from daemon.health.faults import Fault
from daemon.publish.modbus.holding import COMMAND_ADDRESS, CommandCode, Outcome
from daemon.snapshot import State
from tests.daemon.processes.test_process import PATIENCE_S, ROOT, Running, fake_lidar, running

pytestmark = [pytest.mark.realtime, pytest.mark.system]


def modbus(port: int, body: bytes) -> bytes:
    """The answer's body to one request."""
    with create_connection(("127.0.0.1", port), 5.0) as line:
        line.sendall(struct.pack(">HHHB", 1, 0, 1 + len(body), 1) + body)
        return line.recv(300)[7:]


def ask(daemon: Running, number: int, code: CommandCode) -> Outcome:
    """Order something over Modbus; what became of it."""
    modbus(daemon.modbus, struct.pack(">BHHBHH", 16, COMMAND_ADDRESS, 2, 4, number, code))
    for _ in range(200):
        answer = modbus(daemon.modbus, struct.pack(">BHH", 3, COMMAND_ADDRESS + 8, 2))
        acknowledged, outcome = struct.unpack(">HH", answer[2:])
        if acknowledged == number and outcome != Outcome.RUNNING:
            return Outcome(outcome)
        time.sleep(0.05)
    raise AssertionError("no answer within 10 s")


def info(path: Path) -> str:
    command = [sys.executable, "-m", "daemon", "map", "info", str(path)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True, timeout=30.0).stdout


def test_a_map_is_saved_on_command_and_at_the_stop_and_loaded_at_the_next_start(tmp_path: Path) -> None:
    link, folder = tmp_path / "lidar", tmp_path / "maps"
    keys = ("--set", f"map.folder={folder}", "--set", "modbus.write=true")
    with fake_lidar(link):
        with running(link, *keys) as daemon:
            daemon.until(PATIENCE_S, "state", State.TRACKING)
            map_id = daemon.reading()["map_id"]
            assert ask(daemon, 1, CommandCode.SAVE_MAP) is Outcome.DONE
            (first,) = folder.glob("*.lumimap")
            time.sleep(4.0)
            code, log, seconds = daemon.stop()
            assert (code, seconds < 6.0) == (0, True), log
            assert "Traceback" not in log
        files = sorted(folder.glob("*.lumimap"))
        assert len(files) == 2, "what was mapped after the command is saved at the stop"
        assert files[0] == first
        assert f"map id            {map_id:08x}" in info(files[1])
        with running(link, *keys) as daemon:
            posed = daemon.until(PATIENCE_S, "map_id", map_id)
            assert posed["state"] != State.TRACKING
            code, log, _ = daemon.stop()
    assert code == 0
    assert f"map {map_id:08x} of" in log
    left = sorted(folder.glob("*.lumimap"))
    assert left == files or (len(left) == 2 and left[0] == files[1]), "the two newest generations stay"


def test_a_folder_that_cannot_be_made_is_said_and_is_a_fault(tmp_path: Path) -> None:
    link, file = tmp_path / "lidar", tmp_path / "file"
    file.write_text("")
    keys = ("--set", f"map.folder={file / 'maps'}", "--set", "modbus.write=true")
    with fake_lidar(link), running(link, *keys) as daemon:
        daemon.until(PATIENCE_S, "state", State.TRACKING)
        assert ask(daemon, 1, CommandCode.SAVE_MAP) is Outcome.REFUSED
        daemon.until(10.0, "fault", int(Fault.MAP_NOT_SAVED))
        code, log, _ = daemon.stop()
    assert code == 0
    assert log.count("no map can be stored in") == 1
    assert "Not a directory" in log


def test_localisation_without_a_map_is_refused_at_the_start(tmp_path: Path) -> None:
    with running(tmp_path / "lidar", "--set", f"map.folder={tmp_path}", "--set", "map.localise=true") as daemon:
        _, log = daemon.process.communicate(timeout=30.0)
    assert daemon.process.returncode == 1
    assert f"{tmp_path}: the folder has no usable map, but `map.localise` is true" in log
