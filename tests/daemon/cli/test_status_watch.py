"""`lumiloop status --watch`: what is shown anew, and for how long."""

import contextlib
import json
import os
import pty
import socket
import termios
from typing import Any

import pytest

from daemon.cli.reports import terminal_screen
from daemon.publish.modbus import client, registers
from daemon.snapshot import Snapshot, Trust
from tests.daemon.cli.test_status import run_against, status, stranger
from tests.daemon.publish.modbus.test_light_blocks import picture
from tests.daemon.publish.modbus.test_registers import snapshot

Frames = list[list[str]]


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
    assert capsys.readouterr().err.count("no Modbus server runs there") == 1  # of three looks


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


def on_screen(monkeypatch: pytest.MonkeyPatch, taken: Snapshot, columns: int, rows: int, pressed: str = "") -> Frames:
    """The lines of every picture on a terminal, to the end of the keys that are pressed (q at the last)."""
    taken_keys = iter([*pressed, None])

    def press(_: float) -> str:
        if (one := next(taken_keys)) is None:
            raise KeyboardInterrupt
        return terminal_screen.KEYS[one]

    written: list[str] = []
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    monkeypatch.setattr("sys.stdout.write", written.append)
    monkeypatch.setattr("shutil.get_terminal_size", lambda *_: os.terminal_size((columns, rows)))
    monkeypatch.setattr("daemon.cli.status.keyboard", lambda: contextlib.nullcontext(True))
    monkeypatch.setattr("daemon.cli.status.key", press)
    with stranger(registers.encode_block(taken)) as address, contextlib.suppress(KeyboardInterrupt):
        assert status(address, watch=True) == 0
    pictures = "".join(written).split(terminal_screen.CLEAR)[1:]
    return [one.rstrip("\n").split("\n") for one in pictures]


def test_a_small_terminal_shows_state_and_remedy_first_and_cuts_nothing(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = snapshot(reason=4, fault=101)
    with stranger(registers.encode_block(taken)) as address:
        status(address)
    whole = capsys.readouterr().out
    (first, *_, last) = on_screen(monkeypatch, taken, 40, 8, "G")
    assert first[0] == "state      TRACKING"
    assert first[1].startswith("reason     4: ")
    assert len(first) == 8
    assert max(map(len, [*first, *last])) <= 40
    assert " ".join(wrapped := terminal_screen.wrapped(whole, 40, 11)).split() == whole.split()
    assert max(map(len, wrapped)) <= 40
    assert "snapshot" in "\n".join(last)


def test_on_80_by_24_everything_that_matters_is_on_the_first_page(capsys: pytest.CaptureFixture[str]) -> None:
    """A reason and a fault with their remedies, then pose, protection level, faults and lamps, of a real publisher."""
    trust = Trust(horizontal_m=0.1, yaw_rad=0.02, limit_m=0.3, light=True)
    assert run_against(snapshot(reason=4, fault=101, light=picture(), links=3, trust=trust), advance=False) == 0
    whole = terminal_screen.wrapped(capsys.readouterr().out, 80, 11)
    first = whole[:23]
    labels = [line[:11].strip() for line in first if line[0] != " "]
    wanted = [
        "state",
        "reason",
        "map pose",
        "sigma",
        "protection",
        "fault",
        "lights",
        "light fix",
        "light pose",
        "links",
    ]
    assert labels[: len(wanted)] == wanted
    assert "check the lidar's power and cable" in " ".join(" ".join(first).split())
    assert [line for line in whole if " nA" in line] == [line for line in first if " nA" in line] != []


def test_keys_scroll_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    taken = snapshot(reason=0, fault=0)
    pictures = on_screen(monkeypatch, taken, 80, 8, "jjk Ggq")
    tops = [one[0].split()[0] for one in pictures]
    assert tops[0] == "state"
    assert tops[1] == "reason"
    assert tops[3] == "reason"
    assert tops[-1] == "state"
    assert pictures[1][:6] == pictures[0][1:7]
    assert "lines 1 to 7 of" in pictures[0][-1]
    assert len({one[-1] for one in pictures[:5]}) >= 4


def test_without_a_terminal_there_is_no_keyboard() -> None:
    with terminal_screen.keyboard() as keys:
        assert not keys


def test_keys_of_a_real_terminal_are_read_at_once_and_without_an_echo(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave, "r") as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        before = termios.tcgetattr(terminal)
        with terminal_screen.keyboard() as keys:
            assert keys
            for typed, meant in ((b"j", "down"), (b"\x1b[6~", "page down"), (b"q", "quit"), (b"\x1b", ""), (b"x", "")):
                os.write(master, typed)
                assert terminal_screen.key(5.0) == meant
            assert terminal_screen.key(0.01) == ""
        assert termios.tcgetattr(terminal) == before
    os.close(master)


def test_on_a_terminal_watching_repaints(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    def nap(_: float) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("daemon.cli.status.time.sleep", nap)
    monkeypatch.setattr("sys.stdout.isatty", lambda: True)
    with stranger(registers.encode_block(snapshot(reason=0, fault=0))) as address, pytest.raises(KeyboardInterrupt):
        status(address, watch=True)
    assert capsys.readouterr().out.startswith("\x1b[H\x1b[2Jstate      TRACKING\n")
