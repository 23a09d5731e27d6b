"""Standard streams that are closed, and the socket of the service manager."""

import errno
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.system.sd_notify import notify


@pytest.mark.parametrize("abstract", [False, True])
def test_words_arrive_as_one_datagram(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool) -> None:
    name = f"@lumiloop-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(name.replace("@", "\0", 1))
        manager.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        notify("READY=1", "STATUS=running")
        assert manager.recv(100) == b"READY=1\nSTATUS=running"


@pytest.mark.parametrize("address", [None, "", "nonsense", "/nowhere/at/all"])
def test_without_a_manager_nothing_happens(monkeypatch: pytest.MonkeyPatch, address: str | None) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    if address is not None:
        monkeypatch.setenv("NOTIFY_SOCKET", address)
    notify("WATCHDOG=1")


def test_without_a_free_file_descriptor_nothing_happens(monkeypatch: pytest.MonkeyPatch) -> None:
    def none_left(*kind: object) -> None:
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setenv("NOTIFY_SOCKET", "/run/notify")
    monkeypatch.setattr(socket, "socket", none_left)
    notify("WATCHDOG=1")


ROOT = Path(__file__).parents[3]
CODE = """
import os, sys
from pathlib import Path
from daemon import __main__
from daemon.system.logging import start_log
sys.argv = ["lumiloop", "--schema"]
assert __main__.main() == 0
start_log()
print("to stderr", file=sys.stderr, flush=True)
Path(os.environ["FOUND"]).write_text(str(os.open(os.devnull, os.O_RDONLY)))
"""


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_closed_standard_streams_receive_nothing_that_is_opened(tmp_path: Path, closed: str) -> None:
    found = tmp_path / "found"
    words = ["sh", "-c", f'exec "$0" -c "$1" {closed}', sys.executable, CODE]
    done = subprocess.run(words, cwd=ROOT, env={"FOUND": str(found)}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(found.read_text()) > 2
    assert done.stderr == ("" if "2>&-" in closed else "to stderr\n")
