"""A daemon that is started beside one of the same name says so before anything is refused to it."""

import logging
import os
import shutil
import socket
import tempfile
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.config.paths import streams_served
from daemon.system import console

REFUSED = ("run", "--set", "map.localise=true", "--set", "modbus.port=0")
"""A run that ends at once: it needs a map, and there is none."""


@pytest.mark.parametrize("where", ["own", "service"])
def test_one_of_the_same_name_runs_already(
    where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "own"))
    monkeypatch.setattr("daemon.config.paths.SERVICE", tmp_path / "service")
    (tmp_path / where).mkdir()
    caplog.set_level(logging.WARNING)
    command = [*REFUSED, "--set", f"map.folder={tmp_path}/maps", "--set"]
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as other:
        other.bind(str(tmp_path / where / "bay3.stream"))
        other.listen()
        assert parser.main([*command, "name=bay4"]) == console.FAILED
        assert "already" not in caplog.text
        assert parser.main([*command, "name=bay3"]) == console.FAILED
        assert (
            f"a daemon with the name bay3 runs on this computer already ({tmp_path / where / 'bay3.stream'})"
            in caplog.text
        )
    caplog.clear()
    assert parser.main([*command, "name=bay3"]) == console.FAILED  # what a dead one has left is none
    assert "already" not in caplog.text


@pytest.mark.parametrize("closed", ["socket", "folder"])
def test_one_whose_stream_is_not_open_to_us_is_seen_too(closed: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The service's, started by another user without its group."""
    folder = Path(tempfile.mkdtemp(prefix="lumiloop-"))
    folder.chmod(0o755)
    monkeypatch.setattr("daemon.config.paths.SERVICE", folder)
    path, dead = folder / "bay3.stream", folder / "bay4.stream"
    us = os.geteuid()
    with socket.socket(socket.AF_UNIX) as other, socket.socket(socket.AF_UNIX) as bound:
        try:
            other.bind(str(path))
            other.listen()
            bound.bind(str(dead))
            for one in (path, dead) if closed == "socket" else (folder,):
                one.chmod(0)
            if us == 0:
                os.seteuid(65534)
            with pytest.raises(PermissionError), socket.socket(socket.AF_UNIX) as link:
                link.connect(str(path))
            assert streams_served("bay3") == [path]
            assert streams_served("bay4") == []
        finally:
            os.seteuid(us)
            folder.chmod(0o755)
            shutil.rmtree(folder)
