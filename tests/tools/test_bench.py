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
from tools.bench._children import ROOT
from tools.bench.recording import processor_s


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
import json, time
from tools.bench import {module}
with {module}.{block} as told:
    print(told{item}, flush=True)
    time.sleep(60)
"""


@pytest.mark.parametrize(
    ("module", "block", "item"), [("modbus", "servers()", "[modbus.OURS]"), ("modbus_load", "server()", "[0]")]
)
def test_servers_do_not_outlive_a_benchmark_that_is_killed(module: str, block: str, item: str) -> None:
    words = [sys.executable, "-c", STARTS.format(module=module, block=block, item=item)]
    with subprocess.Popen(words, cwd=ROOT, stdout=subprocess.PIPE) as benchmark:
        assert benchmark.stdout is not None
        port = int(benchmark.stdout.readline())
        with socket.create_connection(("127.0.0.1", port), timeout=10.0) as link:
            benchmark.kill()
            link.settimeout(10.0)
            assert link.recv(1) == b"", "whoever serves it has gone"
