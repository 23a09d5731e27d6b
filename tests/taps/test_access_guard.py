"""Who may look, and who may order."""

import asyncio
import subprocess
import sys
from pathlib import Path

import pytest

from daemon.cli.parser import main
from taps.access_guard import Guard, TokenRefused, is_loopback, token_for
from taps.view import command
from taps.view.command import address
from tests.commands import Command

TOKEN = "0123456789abcdef"


@pytest.mark.parametrize("bind", ["127.0.0.1", "localhost", "::1", "127.9.9.9"])
def test_on_loopback_all_look_and_those_with_the_token_order(bind: str) -> None:
    assert is_loopback(bind)
    guard = Guard(bind, TOKEN, True)
    assert guard.may_watch(None)
    assert guard.may_command(TOKEN)
    for told in (None, "", TOKEN + "x", TOKEN[:-1], TOKEN.upper(), 1, [TOKEN], "é" * 16):
        assert not guard.may_command(told)
    assert not Guard(bind, TOKEN).may_command(TOKEN)  # orders are not taken at all
    assert not Guard(bind, None, True).may_command(None)


@pytest.mark.parametrize("bind", ["0.0.0.0", "192.168.1.20", "::", "agv.local", ""])
def test_elsewhere_the_token_is_needed_to_look(bind: str) -> None:
    assert not is_loopback(bind)
    guard = Guard(bind, TOKEN)
    assert guard.may_watch(TOKEN)
    assert not guard.may_watch(None)
    assert not Guard(bind).may_watch(None)  # a server without one shows nothing at all


def test_hosts() -> None:
    local, open_to_all = Guard("127.0.0.1"), Guard("0.0.0.0", TOKEN)
    for host in ("localhost", "LOCALHOST:8090", "127.0.0.1:8090", "[::1]:8090", "[::1]"):
        assert local.host_ok(host)
        assert open_to_all.host_ok(host)
    for host in ("", "evil.example", "localhost.evil.example", "127.0.0.1.evil.example", "evil.example:127"):
        assert not local.host_ok(host)
        assert not open_to_all.host_ok(host)
    for bind in ("127.9.9.9", "agv.factory.example"):
        assert Guard(bind, TOKEN).host_ok(f"{bind.upper()}:8090"), "the address that is printed"
    assert not Guard("", TOKEN).host_ok("")
    for host in ("192.168.1.20:8090", "[fe80::1]:8090"):
        assert not local.host_ok(host)
        assert open_to_all.host_ok(host)


def test_tokens(tmp_path: Path) -> None:
    assert token_for("127.0.0.1", False, None) is None
    for bind, write in (("127.0.0.1", True), ("0.0.0.0", False)):
        first, second = (token_for(bind, write, None) for _ in range(2))
        assert first is not None
        assert len(first) >= 24
        assert first != second
    file = tmp_path / "token"
    file.write_text(f"{TOKEN}\n")
    with pytest.raises(TokenRefused, match="chmod 600"):
        token_for("127.0.0.1", True, file)
    file.chmod(0o600)
    assert token_for("127.0.0.1", True, file) == TOKEN
    for text in ("short", "two\nlines of words here", "é" * 20, "x" * 300):
        file.write_text(text)
        with pytest.raises(TokenRefused, match="16 to 256"):
            token_for("127.0.0.1", True, file)
    with pytest.raises(TokenRefused, match="cannot read the token"):
        token_for("127.0.0.1", True, tmp_path / "none")


def test_the_address_that_is_printed() -> None:
    assert address(Guard("127.0.0.1"), 8090) == "http://127.0.0.1:8090/"
    assert address(Guard("::1", TOKEN), 1) == f"http://[::1]:1/#token={TOKEN}"
    assert "0.0.0.0" not in address(Guard("0.0.0.0", TOKEN), 1)


def test_the_journal_is_told_no_token(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Command) -> None:
    said: list[str] = []
    monkeypatch.setattr(command, "to_journal", lambda: True)
    monkeypatch.setattr(command, "stop_event", stopped)
    monkeypatch.setattr("daemon.system.console.say", said.append)
    assert "--token FILE" in refused("view", "--write", "--port", "0")
    file = tmp_path / "token"
    file.write_text(TOKEN)
    file.chmod(0o600)
    assert main(["view", "--write", "--port", "0", "--token", str(file)]) == 0
    assert TOKEN not in said[0]
    assert said[0].endswith("#token=...")
    monkeypatch.setattr(command, "to_journal", lambda: False)
    assert main(["view", "--write", "--port", "0", "--token", str(file)]) == 0
    assert said[1].endswith(f"#token={TOKEN}")


def stopped() -> asyncio.Event:
    """Somebody has stopped it already."""
    event = asyncio.Event()
    event.set()
    return event


def test_what_cannot_be_shown_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str], refused: Command) -> None:
    assert "no such recording" in refused("view", str(tmp_path / "none"))
    assert main(["view", str(tmp_path), "--write"]) == 2
    assert "accepts no commands" in capsys.readouterr().err
    assert "cannot read the token" in refused("view", "--token", str(tmp_path / "none"), "--write")
    assert "--bind" in refused("view", "--bind", "203.0.113.1", "--port", "0")
    with pytest.raises(SystemExit):
        main(["view", "--port", "70000"])
    assert "70000: not a port; give 1 to 65535" in capsys.readouterr().err


def test_the_page_is_served_without_the_estimator() -> None:
    code = (
        "import sys, taps.view.command\nassert 'numba' not in sys.modules and 'estimator.pipeline' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
