"""The benchmarks' command: what could not run is said in words."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tools.bench.__main__ import main
from tools.bench.support.children import ROOT
from tools.bench.system.recording import processor_s


def test_a_benchmark_without_its_data_says_what_it_needs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["bench", "posegraph", "--out", str(tmp_path)])
    monkeypatch.delenv("LUMILOOP_DATA", raising=False)
    assert main() == 1
    said = capsys.readouterr().out
    assert "posegraph could not run: LUMILOOP_DATA does not name the folder" in said
    assert "RuntimeError(" not in said
    monkeypatch.setenv("LUMILOOP_DATA", str(tmp_path))
    assert main() == 1
    assert f"No such file or directory: '{tmp_path}/posegraphs/m3500.g2o.gz'" in capsys.readouterr().out


def test_processor_time_is_that_of_the_whole_process() -> None:
    until = time.process_time() + 0.1
    before = processor_s(os.getpid())
    while time.process_time() < until:
        pass
    assert 0.07 < processor_s(os.getpid()) - before < 0.5
    assert abs(processor_s(os.getpid()) - time.process_time()) < 0.1


STARTS = """
import sys, time
from tools.bench.support.children import child
part = f"import socket, time; link = socket.create_connection(('127.0.0.1', {sys.argv[1]})); print(1); time.sleep(60)"
with child(sys.executable, "-c", part, mute=True):
    time.sleep(60)
"""


def test_what_a_benchmark_starts_does_not_outlive_one_that_is_killed() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:
        door.settimeout(30.0)
        words = [sys.executable, "-c", STARTS, str(door.getsockname()[1])]
        with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE) as benchmark:
            link = door.accept()[0]
            benchmark.kill()
            assert benchmark.stdout is not None
            assert benchmark.stdout.read() == b"", "what is mute is not heard"
    with link:
        link.settimeout(10.0)
        assert link.recv(1) == b"", "whoever has come has gone"
