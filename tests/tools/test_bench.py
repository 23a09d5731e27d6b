"""The benchmarks' command: what could not run is said in words."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from tools.bench.__main__ import main
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
