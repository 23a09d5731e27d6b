"""A daemon that is started beside one of the same name says so before anything is refused to it."""

from __future__ import annotations

import logging
import socket
from pathlib import Path

import pytest

from daemon import cli

REFUSED = ("run", "--set", "map.localise=true", "--set", "modbus.port=0")
"""A run that ends at once: it needs a map, and there is none."""


@pytest.mark.parametrize("where", ["own", "service"])
def test_one_of_the_same_name_runs_already(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "own"))
    monkeypatch.setattr("daemon.folders.SERVICE", tmp_path / "service")
    (tmp_path / where).mkdir()
    caplog.set_level(logging.WARNING)
    command = [*REFUSED, "--set", f"map.folder={tmp_path}/maps", "--set"]
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(tmp_path / where / "bay3.stream"))
        other.listen()
        assert cli.main([*command, "name=bay4"]) == cli.FAILED
        assert "already" not in caplog.text
        assert cli.main([*command, "name=bay3"]) == cli.FAILED
        assert f"a daemon named bay3 runs on this computer already ({tmp_path / where / 'bay3.stream'})" in caplog.text
    caplog.clear()
    assert cli.main([*command, "name=bay3"]) == cli.FAILED  # what a dead one has left is none
    assert "already" not in caplog.text
