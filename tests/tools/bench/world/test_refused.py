"""A bench computer as the world: files and words that are refused before anything is played."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.bench.world.__main__ import main
from tools.bench.world.scenario import ScenarioError, load

SILENCE = "[[fault]]\nwhat='silence'\nwhere='lidar'\n"
LEAST = '[[expect]]\nwhat = "never"\nis = "LOST"\n'


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("x = 1", "x: a scenario holds"),
        ("world = 3\n" + LEAST, r"world: expected a table"),
        ("[world]\nspeedy = 1\n" + LEAST, r"world\.speedy: known are building"),
        ("[world]\nspeed = 'fast'\n" + LEAST, r"world\.speed: expected a float"),
        ("[world]\nspeed = 9\n" + LEAST, r"0\.05 to 3 m/s"),
        ("[world]\nbuilding = 'barn'\n" + LEAST, r"world\.building: there are bench"),
        ("[world]\nlidar = 'SICK'\n" + LEAST, "no lidar is called 'SICK'"),
        ("title = 'nothing expected'", "cannot fail"),
        ("fault = 1\n" + LEAST, "expected"),
        ("[[expect]]\nwhat = 'luck'", r"expect\[0\]\.what: 'luck' is none of error"),
        ("[[expect]]\nwhat = 'error'", "the number is missing"),
        ("[[expect]]\nwhat = 'state'\nwithin = 1", r"expect\[0\]\.is"),
        ("[[expect]]\nwhat = 'never'\nis = 'HAPPY'", "states are STARTING"),
        ("[[expect]]\nwhat = 'fault'\nis = '104'\nwithin = 1", "faults are numbers"),
        ("[[expect]]\nwhat = 'never'\nis = 'LOST'\nby = 3", r"expect\[0\]\.by: known are what"),
        ("[[expect]]\nwhat = 'lamps'\nat_least = 0.5", "lamps = false"),
        ("=", "not TOML"),
        ("[[fault]]\nwhat='silense'\nwhere='lidar'\n" + LEAST, r"\[\[fault\]\] number 1: .*did you mean silence\?"),
        ("[[fault]]\nwhat='silense'\n" + LEAST, r"'silense' is no fault of any device here; did you mean silence\?"),
        (SILENCE + "[[fault]]\nwhat='carry'\nahed=3.0\n" + LEAST, r"number 2: fault\[1\]\.ahed: .*mean ahead\?"),
        ("[[fault]]\nwhat='carry'\nahead=0.0\n" + LEAST, r"ahead: 0\.0 is outside 1\.\.\."),
        ("[[fault]]\nwhat='baud'\nrate=19200\n" + LEAST, "it has no line rate"),
        ("[[fault]]\nwhat=['dark']\n" + LEAST, r"number 1: fault\[0\]\.what: expected a text, got \['dark'\]"),
        ("[[fault]]\nwhat='dark'\nwhere='adc'\n" + LEAST, "'adc' is no device here"),
    ],
)
def test_a_scenario_that_is_wrong_is_refused_by_file_and_place(text: str, says: str, tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text(text)
    with pytest.raises(ScenarioError, match=says) as raised:
        load(file)
    assert str(raised.value).startswith(str(file))


def test_what_cannot_be_played_is_said_with_the_remedy(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    line = ["--modbus", "127.0.0.1:9", "--lidar"]
    cases = {
        "lap": "--lidar and --modbus missing",
        "laps": "there are cable, carried, garbage, lamps, lap",
        str(tmp_path / "none.toml"): "No such file",
    }
    for name, says in cases.items():
        assert main([name]) == 2
        assert says in capsys.readouterr().out
    for port, says in {
        str(tmp_path / "ttyGS0"): "modprobe g_serial",
        str(tmp_path / "ttyUSB0@115200"): "ftdi_sio",
        "/dev/null": "not a serial port",
        "tcp://here": "tcp://here: no port to listen at: expected tcp://HOST:PORT, as tcp://0.0.0.0:10940",
        "ttyUSB0": "expected /dev/ttyUSB0",
    }.items():
        assert main(["lap", *line, port]) == 2
        assert says in capsys.readouterr().out
    assert main(["lamps", *line, f"pty:{tmp_path / 'l'}", "--light", "dac:/dev/i2c-1"]) == 2
    assert "expected dac:/dev/i2c-1@0x60" in capsys.readouterr().out
    assert main(["lap", *line, f"pty:{tmp_path / 'l'}", "--against", str(tmp_path)]) == 2
    assert "results.json" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        ("lap --local --modbus 192.168.0.20", "without --modbus: leave one or the other out"),
        ("lap --local --lidar pty:x --anyone", "without --lidar, --anyone: leave one or the other out"),
        ("lap --local --write-config DIR", "--write-config is for a robot computer"),
        ("lap --lidar foo --modbus 127.0.0.1 --write-config DIR", "--lidar foo: not a line: expected /dev/ttyUSB0"),
        ("lap --lidar /dev/ttyUSB0@fast --modbus 127.0.0.1", "--lidar /dev/ttyUSB0@fast: not a line"),
        ("lap --write-config DIR", "--lidar and --modbus missing (docs/bench.md has the wiring)\n"),
        (
            "lap cable --lidar pty:x --modbus 127.0.0.1 --write-config DIR",
            "takes one scenario, and 2 are named (lap, cable): name one of them",
        ),
        ("lap --lidar tcp://0.0.0.0 --modbus 127.0.0.1 --write-config DIR", "as tcp://0.0.0.0:10940"),
        ("lamps --lidar pty:x --light tcp://0.0.0.0 --modbus 127.0.0.1 --write-config DIR", "as tcp://0.0.0.0:7777"),
        ("lap --lidar tcp://0.0.0.0:99999 --modbus 127.0.0.1 --write-config DIR", "as tcp://0.0.0.0:10940"),
        ("lap --lidar tcp://0.0.0.0:0 --modbus 127.0.0.1 --write-config DIR", "as tcp://0.0.0.0:10940"),
        ("lap --lidar pty:x --modbus 127.0.0.1:65536 --write-config DIR", "expected HOST:PORT"),
        (
            "lap --lidar pty:x --modbus 127.0.0.1 --odometry udp://h:99999 --write-config DIR",
            "udp://h:99999: expected udp://HOST:PORT",
        ),
        (
            "lamps --lidar pty:x --modbus 127.0.0.1 --light tcp:/0.0.0.0:7 --write-config DIR",
            "--light tcp:/0.0.0.0:7: expected dac:",
        ),
        ("lamps --lidar pty:x --modbus 127.0.0.1 --light unix: --write-config DIR", "--light unix:: expected dac:"),
    ],
)
def test_words_that_do_not_go_together_are_refused_before_anything(
    words: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(words.split()) == 2
    assert says in capsys.readouterr().out
    assert not list(tmp_path.iterdir())
