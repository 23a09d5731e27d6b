"""Help on one screen, examples that run, suggestions, completion in a real shell, and man pages."""

import logging
import os
import pty
import re
import select
import shlex
import shutil
import subprocess
import time
from pathlib import Path

import pytest

from daemon.cli import parser
from daemon.cli.manual.catalogue import EXAMPLES, GROUPS
from daemon.cli.manual.command_parser import every, subcommands
from daemon.cli.manual.completion import script
from daemon.system import console
from daemon.system import logging as our_logging
from tests.commands import Command

ROOT = Path(__file__).parents[4]
NAMES = sorted(subcommands(parser.parser()))


@pytest.mark.parametrize("words", [["--help"], ["help"], ["-h"]])
def test_the_help_fits_one_screen(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    if words == ["help"]:
        assert parser.main(words) == console.OK
    else:
        with pytest.raises(SystemExit) as ended:
            parser.main(words)
        assert ended.value.code == console.OK
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 24
    assert max(map(len, lines)) <= 80
    for name in NAMES:
        assert any(re.search(rf"^ +.*(?<![\w-]){name}(?![\w-])", line) for line in lines), name


def test_every_command_has_a_group_and_two_examples() -> None:
    grouped = [name for group in GROUPS for name in group.commands]
    assert sorted(grouped) == NAMES == sorted(EXAMPLES)


@pytest.mark.parametrize("name", NAMES)
def test_examples_are_command_lines(name: str, done: Command) -> None:
    lines = [line for line, _ in EXAMPLES[name]]
    for line in lines:
        args = parser.parser().parse_args(shlex.split(line))
        assert args.command == name == line.split()[0]
        assert callable(args.body)
    said = done("help", name)
    assert all(f"  lumiloop {line}\n" in said for line in lines)
    assert "--log-level" in said


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["staus"], "did you mean status"),
        (["save_map"], "did you mean save-map"),
        (["status", "--jsn"], "did you mean --json"),
        (["map", "imprt", "x.yaml"], "did you mean import"),
        (["replay", "x", "--out", "y", "--method", "papr"], "did you mean paper"),
        (["completion", "tcsh"], "name bash, zsh, fish"),
        (["qqqqqq"], "`lumiloop help all` lists them"),
    ],
)
def test_misspelt_words_are_answered_with_the_nearest(
    words: list[str], hint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        parser.main(words)
    assert ended.value.code == console.USAGE
    said = capsys.readouterr().err
    assert hint in said
    assert said.count("\n") == 2, "two lines: what is wrong, and where help is"


def test_help_of_a_verb_and_of_nothing(capsys: pytest.CaptureFixture[str], done: Command) -> None:
    assert "usage: lumiloop map import" in done("help", "map", "import")
    assert parser.main(["help", "satus"]) == console.USAGE
    assert "did you mean status" in capsys.readouterr().err


def test_levels_stand_before_or_behind_the_command(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "lumiloop.toml").write_text("")
    levels = {name: logging.getLogger(name).level for name in our_logging.OURS}
    try:
        for words, level in ((["check", "-v"], logging.DEBUG), (["--log-level", "warning", "check"], logging.WARNING)):
            assert parser.main(words) == console.OK
            assert {logging.getLogger(name).level for name in our_logging.OURS} == {level}
            assert "configuration lumiloop.toml" in capsys.readouterr().err
        assert parser.main(["check", "-q"]) == console.OK
        out, err = capsys.readouterr()
        assert out.startswith("lumiloop.toml: good")
        assert err == ""
        assert parser.main(["-q", "check", "missing.toml"]) == console.USAGE
        assert "no such file" in capsys.readouterr().err, "errors are printed all the same"
    finally:
        monkeypatch.setattr(console._Output, "quiet", False)
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)
        assert logging.lastResort is not None
        logging.lastResort.setLevel(logging.WARNING)


def completed(line: str, folder: Path) -> set[str]:
    """What bash offers at the end of a line."""
    words = line.split(" ")
    program = (
        f"source {folder / 'lumiloop.bash'}\n"
        f"COMP_WORDS=({' '.join(map(shlex.quote, words))})\nCOMP_CWORD={len(words) - 1}\n_lumiloop\n"
        'printf "%s\\n" "${COMPREPLY[@]}"\n'
    )
    done = subprocess.run(["bash", "-c", program], cwd=folder, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    return set(done.stdout.split())


def test_bash_completes_commands_verbs_and_options(tmp_path: Path) -> None:
    (tmp_path / "lumiloop.bash").write_text(script("bash", parser.parser()))
    (tmp_path / "drive.log").touch()
    assert completed("lumiloop sta", tmp_path) == {"status"}
    assert completed("lumiloop s", tmp_path) >= {"status", "survey", "set-pose", "save-map", "switch-map"}
    assert completed("lumiloop map i", tmp_path) >= {"import", "info"}
    assert completed("lumiloop -v status --j", tmp_path) == {"--json"}
    assert completed("lumiloop map import --na", tmp_path) == {"--name"}
    assert completed("lumiloop replay dr", tmp_path) == {"drive.log"}
    for line, whole in TYPED.items():
        assert completed(line, tmp_path) == {whole.rpartition(" ")[2]}


TYPED = {
    "lumiloop set-p": "lumiloop set-pose",
    "lumiloop status --js": "lumiloop status --json",
    "lumiloop map ex": "lumiloop map export",
    "lumiloop completion z": "lumiloop completion zsh",
}
"""Beginnings of lines, and what the tabulator key makes of them."""


@pytest.mark.skipif(shutil.which("zsh") is None, reason="zsh is not installed")
@pytest.mark.parametrize("line", TYPED)
def test_zsh_completes_commands_verbs_and_options(line: str, tmp_path: Path) -> None:
    (tmp_path / "script").write_text(script("zsh", parser.parser()))
    terminal, screen = pty.openpty()
    environment = {"PATH": os.environ["PATH"], "TERM": "dumb", "HOME": str(tmp_path)}
    shell = subprocess.Popen(
        ["zsh", "-f", "-i"], stdin=screen, stdout=screen, stderr=screen, env=environment, start_new_session=True
    )
    os.close(screen)
    try:
        prepare = f'cd {tmp_path}; autoload -Uz compinit; compinit -u -D; eval "$(cat script)"; print re""ady\n'
        assert "ready" in printed(terminal, prepare, "ready")
        assert TYPED[line] in printed(terminal, line + "\t", TYPED[line])
    finally:
        shell.kill()
        shell.wait()
        os.close(terminal)


def printed(terminal: int, keys: str, wanted: str) -> str:
    """What a terminal shows after these keys, without bells and repaired characters, until it has what is wanted."""
    os.write(terminal, keys.encode())
    seen, text, end = b"", "", time.monotonic() + 30.0
    while wanted not in text and select.select([terminal], [], [], max(0.0, end - time.monotonic()))[0]:
        seen += os.read(terminal, 4096)
        text = re.sub(r"\a|.\x08", "", seen.decode(errors="replace"))
    return text


@pytest.mark.skipif(shutil.which("fish") is None, reason="fish is not installed")
@pytest.mark.parametrize("line", TYPED)
def test_fish_completes_commands_verbs_and_options(line: str, tmp_path: Path) -> None:
    (tmp_path / "script").write_text(script("fish", parser.parser()))
    program = f"source script; complete -C {shlex.quote(line)}"
    environment = {"PATH": os.environ["PATH"], "HOME": str(tmp_path)}
    done = subprocess.run(
        ["fish", "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True, check=True
    )
    assert [row.partition("\t")[0] for row in done.stdout.splitlines()] == [TYPED[line].rpartition(" ")[2]]


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_scripts_hold_every_command_and_are_valid(shell: str, tmp_path: Path, done: Command) -> None:
    text = done("completion", shell)
    for words, command in every(parser.parser()):
        assert words[-1] in text
        for action in command._actions:
            for option in action.option_strings:
                assert (f"-l {option[2:]}" if shell == "fish" and option.startswith("--") else option[1:]) in text
    if (program := shutil.which(shell)) is not None:
        file = tmp_path / "script"
        file.write_text(text)
        subprocess.run([program, "-n", str(file)], check=True)


def test_man_pages_of_every_command(tmp_path: Path, done: Command) -> None:
    assert parser.main(["man", "--out", str(tmp_path)]) == console.OK
    assert {path.name for path in tmp_path.iterdir()} == {"lumiloop.1", *(f"lumiloop-{name}.1" for name in NAMES)}
    page = (tmp_path / "lumiloop-set-pose.1").read_text()
    assert ".SH NAME\nlumiloop\\-set\\-pose \\- set the robot's pose in the map\n" in page
    assert ".B lumiloop set\\-pose 1.5 \\-2 90\n" in page
    for path in tmp_path.iterdir():
        bad = [line for line in path.read_text().splitlines() if re.match(r"['.](?!TH|SH|SS|TP|PP|BR?\b)", line)]
        assert not bad, f"{path.name}: {bad}"
    assert done("man", "run").endswith((tmp_path / "lumiloop-run.1").read_text())
    assert parser.main(["man", "fly"]) == console.USAGE
    if (groff := shutil.which("groff")) is not None:
        pages = [str(path) for path in tmp_path.iterdir()]
        done = subprocess.run([groff, "-man", "-ww", "-Tascii", *pages], capture_output=True, text=True, check=True)
        assert done.stderr == ""


def test_the_installer_lays_down_pages_and_scripts_and_removes_them(tmp_path: Path) -> None:
    environment = {"PATH": "/usr/bin:/bin", "DESTDIR": str(tmp_path), "PREFIX": "/opt/lumiloop"}
    install = str(ROOT / "systemd" / "install.sh")
    subprocess.run([install, "files"], env=environment, check=True, capture_output=True)
    share = tmp_path / "usr/share"
    made = [
        share / "man/man1/lumiloop.1",
        share / "man/man1/lumiloop-run.1",
        share / "bash-completion/completions/lumiloop",
        share / "zsh/vendor-completions/_lumiloop",
        share / "fish/vendor_completions.d/lumiloop.fish",
    ]
    assert all("lumiloop" in path.read_text() for path in made)
    subprocess.run([install, "uninstall"], env=environment, check=True, capture_output=True)
    assert [path for path in share.rglob("*") if path.is_file()] == []
