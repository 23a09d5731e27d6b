"""Where the configuration is found, what says so, and `lumiloop config`."""

import logging
import tomllib
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.config import discovery, loader
from daemon.config.discovery import find
from daemon.system import console
from tests.commands import Command

PLACES = ["variable.toml", "lumiloop.toml", "home/lumiloop/lumiloop.toml", "etc/lumiloop.toml"]


@pytest.fixture
def places(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """A file in each place, in order; each names a robot after its place."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("LUMILOOP_CONFIG", str(tmp_path / PLACES[0]))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    monkeypatch.setattr(discovery, "SYSTEM", tmp_path / "etc")
    paths = [tmp_path / place for place in PLACES]
    for number, path in enumerate(paths):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"name = 'robot{number}'\n")
    return paths


def test_the_places_have_an_order(places: list[Path], monkeypatch: pytest.MonkeyPatch) -> None:
    named = find(Path("other.toml"))
    assert (named.file, named.named) == (Path("other.toml"), True)
    found = []
    for path in places:
        found.append(find(None).file)
        path.unlink()
        monkeypatch.delenv("LUMILOOP_CONFIG", raising=False)
    assert [file.resolve() for file in found if file is not None] == places
    assert find(None).file is None


def test_a_missing_file_of_the_variable_is_an_error(
    places: list[Path], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    places[0].unlink()
    assert parser.main(["check"]) == console.USAGE
    assert f"{places[0]}: no such file" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["check"], ["config", "show"], ["run", "--print-config"]])
def test_commands_say_what_they_use(places: list[Path], words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert parser.main(words) == console.OK
    out, err = capsys.readouterr()
    first = (err or out).splitlines()[0]
    assert f"configuration {places[0]} ($LUMILOOP_CONFIG)" in first.replace("configuration:", "configuration")
    assert parser.main([*words[:2], "--config", str(places[2]), *words[2:]]) == console.OK
    out, err = capsys.readouterr()
    assert err == ""
    assert str(places[2]) in out or 'name = "robot2"' in out


def test_a_command_uses_the_configuration_that_was_found(places: list[Path], refused: Command) -> None:
    """`status` finds the daemon's port in it."""
    places[0].write_text("[modbus]\nport = 1\n")
    assert "127.0.0.1:1:" in refused("status")


def test_the_log_of_a_run_names_the_file_and_no_more(
    places: list[Path], caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    from daemon.cli import run

    monkeypatch.setattr(run, "start_log", lambda *_: None)
    monkeypatch.setattr(run, "streams_served", lambda name: [])

    def stop(*_: object) -> None:
        raise run.NoMap("no map")

    monkeypatch.setattr(run, "_environment", stop)
    with caplog.at_level(logging.INFO):
        assert parser.main(["run", "--set", "modbus.port=7"]) == console.FAILED
    first = caplog.records[0].getMessage()
    assert first == f"robot0: configuration {places[0]} ($LUMILOOP_CONFIG), with 1 values of the command line"
    assert "port = 7" not in caplog.text


def test_init_writes_a_template_that_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    assert parser.main(["config", "init"]) == console.OK
    file = tmp_path / "lumiloop.toml"
    assert loader.load(file) == loader.load(None)
    assert all(option.description in file.read_text() for option in loader.options())
    assert "--force" in refused("config", "init")
    uncommented = "".join(
        line.removeprefix("# ") if " = " in line else line for line in file.read_text().splitlines(keepends=True)
    )
    assert tomllib.loads(uncommented)["modbus"]["port"] == 1502


def test_show_says_where_it_looked(places: list[Path], monkeypatch: pytest.MonkeyPatch, done: Command) -> None:
    for path in places:
        path.unlink()
    monkeypatch.delenv("LUMILOOP_CONFIG")
    said = done("config", "show")
    assert said.startswith("# configuration: built-in values; no file was found\n# searched:\n#   lumiloop.toml (")
    assert tomllib.loads(said)["name"] == "lumiloop"


def test_set_changes_the_file_and_keeps_its_comments(places: list[Path], capsys: pytest.CaptureFixture[str]) -> None:
    places[0].write_text("# hall 3\nname = 'a'  # the first\n")
    assert parser.main(["config", "set", "modbus.port=502", "name=b"]) == console.OK
    assert places[0].read_text() == '# hall 3\nname = "b"  # the first\n\n[modbus]\nport = 502\n'
    assert parser.main(["config", "set", "modbus.port=x"]) == console.USAGE
    assert "`modbus.port`" in capsys.readouterr().err
    assert "502" in places[0].read_text(), "a wrong value is not written"
