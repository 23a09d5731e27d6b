"""The command line's own behaviour: dispatch, exit codes, and that refusals are text, not tracebacks."""

import json
import os
import signal
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest

from daemon.cli import inputs, parser
from daemon.config.paths import maps_folder
from daemon.config.schema import Config
from daemon.system import console
from tests.commands import Command

ROOT = Path(__file__).parents[3]


def test_check_good_and_bad(tmp_path: Path, capsys: pytest.CaptureFixture[str], done: Command) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[modbus]\nport = 5020\n")
    good, maps = done("check", str(file)).splitlines()
    assert good == f"{file}: good"
    assert maps == f"{maps_folder('')}: the folder does not exist yet; the daemon creates it for its maps"
    file.write_text("[modbus]\nport = 'x'\n")
    assert parser.main(["check", str(file)]) == console.USAGE
    assert capsys.readouterr().err.startswith(f'lumiloop: {file}:2: `modbus.port` = "')


def test_a_program_reads_what_check_finds(tmp_path: Path, capsys: pytest.CaptureFixture[str], done: Command) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("[modbus]\nport = 5020\n")
    told = json.loads(done("check", str(file), "--json"))
    assert (told["schema"], told["file"], told["good"]) == ("lumiloop.check/1", str(file), True)
    file.write_text("[modbus]\nport = 'x'\n")
    assert parser.main(["check", str(file), "--json"]) == console.USAGE
    told = json.loads(capsys.readouterr().out)
    assert told["good"] is False
    assert told["problems"][0].startswith(f"{file}:2: `modbus.port`")


@pytest.mark.parametrize("words", [["check", "robot.toml"], ["--print-config"], ["run", "--print-config"]])
def test_small_commands_load_neither_numpy_nor_numba(tmp_path: Path, words: list[str]) -> None:
    (tmp_path / "robot.toml").write_text("name = 'r1'\n")
    code = (
        f"import sys\nfrom daemon.cli.parser import main\nassert main({words!r}) == 0\n"
        "assert not {'numba', 'numpy', 'asyncio'} & set(sys.modules)"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_print_config_resolves_file_and_overrides(tmp_path: Path, done: Command) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("name = 'r7'\n")
    words = ["run", "--config", str(file), "--lidar", "/dev/ttyACM1", "--set", "modbus.port=0", "--print-config"]
    printed = tomllib.loads(done(*words))
    assert (printed["name"], printed["lidar"]["device"], printed["modbus"]["port"]) == ("r7", "/dev/ttyACM1", 0)


@pytest.mark.parametrize("flag", ["--schema", "--reference", "--print-config", "--version"])
def test_printed_facts(flag: str, done: Command) -> None:
    assert done(flag).endswith("\n")


def test_no_command_shows_help_as_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert parser.main([]) == console.USAGE
    assert "COMMAND" in capsys.readouterr().err


def test_unknown_command_is_wrong_usage(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        parser.main(["fly"])
    assert caught.value.code == console.USAGE
    assert "fly" in capsys.readouterr().err


def _command(monkeypatch: pytest.MonkeyPatch, error: BaseException | None) -> list[object]:
    """Replace replay's module by one that keeps what it was called with."""
    seen: list[object] = []

    def body(args: object) -> int:
        seen.append(args)
        if error is not None:
            raise error
        return 7

    module = types.ModuleType("daemon.cli.replay")
    module.main = body  # type: ignore[attr-defined]  # a module made for this test
    monkeypatch.setitem(sys.modules, "daemon.cli.replay", module)
    monkeypatch.setattr(inputs, "log", lambda args: None)
    return seen


def test_a_command_gets_the_settings_and_its_code_is_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = _command(monkeypatch, None)
    assert parser.main(["replay", "x.log", "--out", "o", "--set", "name=r9"]) == 7
    settings = seen[0].settings  # type: ignore[attr-defined]  # argparse.Namespace
    assert isinstance(settings, Config)
    assert settings.name == "r9"


def test_an_interrupt_is_not_a_traceback(monkeypatch: pytest.MonkeyPatch) -> None:
    _command(monkeypatch, KeyboardInterrupt())
    assert parser.main(["replay", "x.log", "--out", "o"]) == console.INTERRUPTED


INTERRUPTED_WHILE_LOADING = """
import os, signal, sys

class Interrupt:
    def find_spec(self, name, *_):
        if name == "daemon.cli.parser":
            os.kill(os.getpid(), signal.SIGINT)

sys.meta_path.insert(0, Interrupt())
from daemon.__main__ import main
sys.exit(main())
"""


def test_an_early_interrupt_ends_without_a_traceback() -> None:
    # a job in the background inherits that interrupts are ignored
    code = "import signal\nsignal.signal(signal.SIGINT, signal.default_int_handler)" + INTERRUPTED_WHILE_LOADING
    command = [sys.executable, "-c", code, "run"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_an_interrupt_that_is_ignored_stays_ignored() -> None:
    code = "import signal\nsignal.signal(signal.SIGINT, signal.SIG_IGN)" + INTERRUPTED_WHILE_LOADING
    command = [sys.executable, "-c", code, "--print-config"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0
    assert "[modbus]" in done.stdout


@pytest.mark.parametrize(
    ("text", "says"), [("ten", "'ten' is not a number of minutes"), ("0", "0 minutes"), ("1441", "1441")]
)
def test_a_ring_that_is_none_is_said_with_what_may_be(text: str, says: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser.main(["run", "--record", "x", "--last", text])
    said = capsys.readouterr().err
    assert f"{says}" in said
    assert "give 1 to 1440" in said
