"""`lumiloop status --watch`: what is shown anew, and for how long."""

from __future__ import annotations

import json
import os
import socket
from typing import Any

import pytest

from daemon.publish.modbus import client, registers
from tests.daemon.cli.test_status import status, stranger
from tests.daemon.publish.modbus.test_registers import snapshot


def test_watching_goes_on_until_interrupted(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    naps = iter(range(3))

    def nap(_: float) -> None:
        if next(naps, None) is None:
            raise KeyboardInterrupt

    monkeypatch.setattr("daemon.cli.status.time.sleep", nap)
    with stranger(registers.encode_block(snapshot(reason=0, fault=0))) as address, pytest.raises(KeyboardInterrupt):
        status(address, watch=True, json=True)
    lines = capsys.readouterr().out.splitlines()
    assert [json.loads(line)["snapshot"]["stalled"] for line in lines] == [False, True, True, True]


def test_watching_shows_when_the_daemon_is_away(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    naps = iter(range(2))

    def nap(_: float) -> None:
        if next(naps, None) is None:
            raise KeyboardInterrupt

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
    monkeypatch.setattr("daemon.cli.status.time.sleep", nap)
    with pytest.raises(KeyboardInterrupt):
        status(f"127.0.0.1:{port}", watch=True)
    assert capsys.readouterr().err.count("nothing serves Modbus there") == 1  # of three looks


def test_watching_says_anew_what_is_new(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    away, refused = client.NoAnswer("away"), client.NoAnswer("refused")
    looks = iter([away, away, refused, {"seq": 1}, refused])

    def read(_: client.Reader) -> Any:
        look = next(looks, KeyboardInterrupt())
        if isinstance(look, BaseException):
            raise look
        return look

    monkeypatch.setattr(client.Reader, "read", read)
    monkeypatch.setattr("daemon.cli.status.time.sleep", lambda _: None)
    monkeypatch.setattr("daemon.cli.status._show", lambda *_: None)
    with pytest.raises(KeyboardInterrupt):
        status("127.0.0.1:1", watch=True)
    said = [line.removeprefix("lumiloop: ") for line in capsys.readouterr().err.splitlines()]
    assert said == ["away; waiting", "refused; waiting", "refused; waiting"]


def test_on_a_small_terminal_watching_keeps_the_first_lines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def nap(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("daemon.cli.status.time.sleep", nap)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("shutil.get_terminal_size", lambda *_: os.terminal_size((40, 8)))
    with stranger(registers.encode_block(snapshot(reason=0, fault=0))) as address, pytest.raises(KeyboardInterrupt):
        status(address, watch=True)
    lines = capsys.readouterr().out.removeprefix("\x1b[H\x1b[2J").splitlines()
    assert lines[0] == "state      TRACKING"
    assert len(lines) == 7  # and the cursor's
    assert max(map(len, lines)) <= 40
    assert lines[-1] == "... 9 more lines: a higher window"


def test_on_a_terminal_watching_repaints(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def nap(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("daemon.cli.status.time.sleep", nap)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    with stranger(registers.encode_block(snapshot(reason=0, fault=0))) as address, pytest.raises(KeyboardInterrupt):
        status(address, watch=True)
    assert capsys.readouterr().out.startswith("\x1b[H\x1b[2Jstate      TRACKING\n")
