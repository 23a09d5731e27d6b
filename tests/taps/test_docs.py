"""Commands in the documents of the taps are commands: each is understood, and those that need no daemon are run."""

import argparse
import re
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.cli import parser as cli_parser
from daemon.diagnosis.host import Host
from daemon.system import console
from tests.daemon.commissioning.test_planning import room, write_pgm
from tests.daemon.diagnosis.test_doctor import Computer

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]


def commands(page: Path) -> list[list[str]]:
    """What stands behind `lumiloop` in blocks of code, without comments and pipes; what may be left out is there."""
    found = []
    text = page.read_text().replace("\\\n", "")
    for line in re.findall(r"^ {4,}(?:sudo )?lumiloop (.+)$", text, re.MULTILINE):
        words = shlex.split(re.sub(r"\[(--[^\]]*)\]", r"\1", line), comments=True)
        ends = [words.index(word) for word in ("|", ">", ">>", "&", "&&", ";") if word in words]
        found.append(words[: min(ends, default=len(words))])
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_command_in_the_documents_is_understood(page: Path) -> None:
    for words in commands(page):
        if words != ["--help"]:
            assert cli_parser.parser().parse_args(words).body is not None, f"{page.name}: {words}"


def parsers(parser: argparse.ArgumentParser) -> Iterator[argparse.ArgumentParser]:
    """A parser, and those of its commands and their verbs."""
    yield parser
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for below in action.choices.values():
                yield from parsers(below)


def test_every_command_and_verb_has_help() -> None:
    every = list(parsers(cli_parser.parser()))
    assert len(every) > 30
    for parser in every:
        assert parser.format_help().startswith("usage: ")


def test_the_doctor_of_the_documents(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (words,) = (words for words in commands(ROOT / "docs" / "installation.md") if words[0] == "doctor")
    (tmp_path / "lumiloop.toml").write_text("")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("daemon.cli.doctor.Host", Computer)
    assert cli_parser.main(words) == console.OK
    assert "no problem was found" in capsys.readouterr().out
    assert issubclass(Computer, Host)


@pytest.mark.system
def test_the_plans_of_the_documents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_pgm(tmp_path, room(5.0, 4.0))
    ran = 0
    for words in commands(ROOT / "docs" / "planning.md"):
        if words[0] == "plan":
            assert cli_parser.main(words) == console.OK, words
            ran += 1
    assert ran == 4
    assert (tmp_path / "plan" / "lights.toml").exists()


@pytest.mark.system
def test_the_exports_of_the_documents(recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rosbags", reason="pip install 'lumiloop[mcap]'")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "drive").symlink_to(recording)
    ran = 0
    for words in commands(ROOT / "docs" / "formats.md"):
        if words[0] == "export":
            assert cli_parser.main(words) == console.OK, words
            (tmp_path / "torn.mcap").write_bytes((tmp_path / "drive.mcap").read_bytes()[:-500])
            ran += 1
    assert ran == 2
    assert {path.name for path in tmp_path.iterdir()} >= {"drive.mcap", "drive.tum", "whole.mcap"}


@pytest.mark.system
def test_the_program_of_the_documents_reads_what_was_exported(
    recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("rosbags", reason="pip install 'lumiloop[mcap]'")
    (program,) = re.findall(
        r"^```python\n(.*?)^```", (ROOT / "docs" / "formats.md").read_text(), re.MULTILINE | re.DOTALL
    )
    monkeypatch.chdir(tmp_path)
    assert cli_parser.main(["export", str(recording), "--mcap", "drive.mcap"]) == console.OK
    capsys.readouterr()
    exec(compile(program, "formats.md", "exec"), {})
    said = capsys.readouterr().out.splitlines()
    assert len([line for line in said if len(line.split()) == 4]) > 70
    assert any(line.split()[1] == "MAPPING" for line in said)
