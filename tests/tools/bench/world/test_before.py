"""A bench computer as the world: what is said and written before the drive, and what is said last after it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.config.loader import load as load_config
from tools.bench.report.page import write
from tools.bench.report.result import About, Figure, Result
from tools.bench.world import __main__ as world
from tools.bench.world.__main__ import main
from tools.bench.world.judge import Read
from tools.bench.world.scenario import ScenarioError, load
from tools.bench.world.stage import Ends, why_no_pose

ROOT = Path(__file__).parents[4]
LEAST = '[[expect]]\nwhat = "never"\nis = "LOST"\n'


def test_the_scenario_of_the_page_is_one(tmp_path: Path) -> None:
    page = (ROOT / "docs" / "bench.md").read_text()
    (text,) = [block.partition("```")[0] for block in page.split("```toml\n")[1:] if "[[expect]]" in block]
    (tmp_path / "my.toml").write_text(text)
    made = load(tmp_path / "my.toml")
    assert {fault["what"] for fault in made.faults} == {"silence", "carry"}
    assert max(one.until for one in made.expect) == 35.0


def test_a_report_that_cannot_be_written_or_compared_is_said_before_the_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(world, "tried", lambda *_: pytest.fail("nothing may be driven"))
    line = ["lap", "--modbus", "127.0.0.1:9", "--lidar", f"pty:{tmp_path / 'l'}"]
    (tmp_path / "file").touch()
    assert main([*line, "--out", str(tmp_path / "file" / "out")]) == 2
    assert "name another folder with --out" in capsys.readouterr().out
    good = Result("boots", "boots", True, 1.0, "")
    for bench, says in {"bench-vm": "is a report of bench-vm", "bench-world": "nothing of what is to be tried"}.items():
        write(tmp_path / bench, [good], About(bench, "", {}))
        assert main([*line, "--against", str(tmp_path / bench)]) == 2
        assert says in capsys.readouterr().out
    dac = ["--light", "dac:/dev/i2c-1@0x60"]
    file = tmp_path / "dark.toml"
    lamps = '[world]\nlamps = true\nbuilding = "paper_room"\n'
    file.write_text(lamps + "[[fault]]\nwhat = 'dark'\nwhere = 'adc'\n" + LEAST)
    assert main([str(file), *line[1:], *dac]) == 2
    assert "no fault can be ordered" in capsys.readouterr().out


def test_what_is_worse_is_said_last_and_fails_the_run(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    error = Figure("error, median", 3.0, "mm", "more")
    lap = Result("lap.error", "a lap", True, 17.0, "seen", figures=(error,))
    monkeypatch.setattr(world, "tried", lambda *_: [lap])
    line = ["lap", "--modbus", "127.0.0.1:9", "--lidar", "pty:x", "--out"]
    assert main([*line, str(tmp_path / "w1")]) == 0
    lap = replace(lap, figures=(replace(error, value=9.0),))
    assert main([*line, str(tmp_path / "w2"), "--against", str(tmp_path / "w1")]) == 1
    *_, count, told, worse, last = capsys.readouterr().out.splitlines()
    assert count.startswith("1 of 1 as expected")
    assert "1 of 1 outcomes, 1 of 1 figures" in told
    assert worse.startswith("worse than before: lap.error: error, median: 9 mm, 3 then")
    assert last == "FAILED: 1 worse than before"


def test_the_robot_computers_files_are_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Good ones, with all that the drive takes; what is there is not overwritten."""
    folder = tmp_path / "robot"
    ends = ["--lidar", "tcp://0.0.0.0:10999", "--light", "tcp://0.0.0.0:7799", "--modbus", "127.0.0.1:1599"]
    words = ["lamps", *ends, "--odometry", "udp://127.0.0.1:5699", "--write-config", str(folder)]
    assert main(words) == 0
    assert "copy all of it" in capsys.readouterr().out
    config = load_config(folder / "lumiloop.toml")
    assert (config.lidar.device, config.lidar.mount.x) == ("tcp://127.0.0.1:10999", 0.15)
    assert (config.bind, config.allow, config.modbus.port) == ("0.0.0.0", ("127.0.0.1",), 1599)
    assert config.map.folder == "none", "it would look for itself in a map of another drive"
    assert (config.odometry.port, config.photodiode.bus) == (5699, "tcp://127.0.0.1:7799")
    assert (
        subprocess.run(
            [sys.executable, "-m", "daemon", "check", str(folder / "lumiloop.toml")], cwd=ROOT, capture_output=True
        ).returncode
        == 0
    )
    assert main(words) == 2
    assert "is there already" in capsys.readouterr().out
    for lidar, device in {
        "/dev/ttyGS0": "/dev/ttyACM0",
        "/dev/ttyUSB3@57600": "/dev/ttyUSB0@57600",
        "pty:/tmp/l": "/tmp/l",
    }.items():
        place = tmp_path / device.replace("/", "_")
        assert main(["lap", "--lidar", lidar, "--modbus", "127.0.0.1", "--write-config", str(place)]) == 0
        assert load_config(place / "lumiloop.toml").lidar.device == device
        assert not (place / "lamps.toml").exists()
    assert main(["lamps", *ends[:2], *ends[4:], "--write-config", str(tmp_path / "dark")]) == 2
    assert "say with --light" in capsys.readouterr().out
    for odd in (["--lidar", "tcp://here"], ["--odometry", "192.168.0.20:5601"], ["--modbus", "no.such.host.invalid"]):
        words = ["lap", *ends, *odd, "--write-config", str(tmp_path / "odd")]
        assert main(words) == 2
        assert not (tmp_path / "odd").exists(), "nothing is written where something is wrong"
    (tmp_path / "file").touch()
    capsys.readouterr()
    assert main(["lap", *ends, "--write-config", str(tmp_path / "file" / "robot")]) == 2
    assert f"--write-config {tmp_path}/file/robot: Not a directory: name a folder that" in capsys.readouterr().out
    assert main(["lap", "cable", *ends, "--write-config", str(tmp_path / "two")]) == 2
    assert "takes one scenario, and 2 are named" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("what", "says"),
    [
        ('[[fault]]\nwhat = "hangup"\nwhere = "lidar"\nwhen = 40\n', r"number 1: when: 40 s is not before the end"),
        ('[[expect]]\nwhat = "clear"\nwithin = 4.0\nfrom = 41.0\n', r"expect\[1\]\.from: 41 s is not before the end"),
        (
            '[[expect]]\nwhat = "error"\nat_most = 0.1\nfrom = 9.0\nuntil = 8.0\n',
            r"until: 8 s is not after its `from`, 9",
        ),
    ],
)
def test_what_would_never_come_is_refused_before_the_drive(tmp_path: Path, what: str, says: str) -> None:
    """It could not fail either: a fault after the end would be survived by anybody."""
    file = tmp_path / "late.toml"
    file.write_text(LEAST + what)
    with pytest.raises(ScenarioError, match=says):
        load(file)


def test_a_robot_computer_that_looks_for_itself_in_a_map_is_told_apart_from_one_without_a_lidar() -> None:
    ends = Ends("tcp://127.0.0.1:10940", ("127.0.0.1", 1502))
    looking, silent = (why_no_pose(Read(0.0, state), ends, 120.0) for state in ("RELOCATING", "NO_LIDAR"))
    assert 'folder = "none"' in looking
    assert "lidar.device" not in looking
    assert "lidar.device" in silent
