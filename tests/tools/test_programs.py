"""Programs of the tools: modules can be imported, clients say how they are used, a soak sees growth."""

import importlib
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tools.soak.watched import Watch, growth, stored

CLIENTS = Path(__file__).parents[2] / "tools/clients"


@pytest.mark.parametrize("name", ["read_modbus", "read_lights", "subscribe_pose", "send_odometry", "send_command"])
@pytest.mark.parametrize("words", [["--help"], ["127.0.0.1", "no-port"]])
def test_a_client_that_is_misused_says_how_it_is_used(name: str, words: list[str]) -> None:
    told = subprocess.run(
        [sys.executable, str(CLIENTS / f"{name}.py"), *words], capture_output=True, text=True, timeout=20
    )
    assert told.returncode == 1
    assert f"python {name}.py" in told.stderr
    assert "Traceback" not in told.stderr


def test_a_port_at_which_nobody_listens_by_tcp_is_said() -> None:
    command = [sys.executable, str(CLIENTS / "read_modbus.py"), "127.0.0.1", "1", "tcp"]
    told = subprocess.run(command, capture_output=True, text=True, timeout=20)
    assert told.returncode == 1
    assert "is lumiloop running" in told.stderr
    assert "Traceback" not in told.stderr


ROOT = Path(__file__).parents[2]
MODULES = sorted(path for path in (ROOT / "tools").rglob("*.py") if path.name != "__main__.py")


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(ROOT).as_posix())
def test_a_module_can_be_imported(path: Path) -> None:
    """A module that cannot be imported fails; nothing else is asserted."""
    importlib.import_module(".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"))


def watch(slope_mb_h: float, files: int = 10, grows: float = 0.0) -> Watch:
    """Six hours: half an hour of start, then a slope; one file more at the end than at the begin, or as many."""
    rows = []
    for k in range(1, 61):
        hours = 0.1 * k
        memory = 300.0 + min(hours, 0.5) * 200.0 + slope_mb_h * hours
        rows.append(
            (hours, memory, float(10 if k < 50 else files), 2.0, 7.0, 3.0 + hours, 1.0 + grows * hours, 2.0, 3.0)
        )
    return Watch(rows)


def test_a_slope_after_the_start_is_told() -> None:
    by_name = {row.name: row for row in watch(0.1).figures("x")}
    assert by_name["memory, slope"].value == pytest.approx(0.1)
    assert all(row.ok is not False for row in by_name.values())
    assert {row.name: row for row in watch(0.7).figures("x")}["memory, slope"].ok is False


def test_growth_of_descriptors_files_and_cycles_is_told() -> None:
    by_name = {row.name: row for row in watch(0.0, files=11, grows=0.2).figures("x")}
    assert by_name["descriptors, growth"].ok is False
    assert by_name["cycle, slope of the median"].ok is False
    assert by_name["stored_mb, slope"].value == pytest.approx(1.0)
    assert by_name["stored_files, slope"].value == pytest.approx(0.0, abs=1e-9)


def test_a_descriptor_that_is_open_for_a_moment_is_no_growth() -> None:
    assert growth(np.array([23.0, 24.0, 23.0, 23.0, 23.0, 24.0, 23.0, 23.0, 24.0])) == 0.0
    assert growth(np.array([23.0, 23.0, 23.0, 24.0, 24.0, 24.0, 25.0, 25.0, 25.0])) == 2.0


def test_stored_files_are_those_below_the_folder(tmp_path: Path) -> None:
    (tmp_path / "maps").mkdir()
    (tmp_path / "maps" / "one").write_bytes(bytes(1_000_000))
    (tmp_path / "two").write_bytes(bytes(500_000))
    (tmp_path / "link").symlink_to("nowhere")
    (tmp_path / "another name").hardlink_to(next(path for path in tmp_path.rglob("*") if path.is_file()))
    assert stored(tmp_path) == (2.0, 1.5)
    assert stored(None) == (0.0, 0.0)


@pytest.mark.system
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("days", ["0.3", pytest.param("1", marks=pytest.mark.slow)])
def test_nothing_grows_in_a_day(days: str, tmp_path: Path) -> None:
    """Seven hours of it where a suite has minutes: the slope counts from a third of it on."""
    command = [sys.executable, "-m", "tools.soak", "--days", days, "--out", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    rows = {row["name"]: row["value"] for row in json.loads((tmp_path / "days.json").read_text())}
    assert rows["memory, slope"] <= 0.5, done.stdout
    assert rows["descriptors, growth"] == rows["threads, growth"] == 0.0
    assert rows["cycles in TRACKING"] > 0.3
    assert rows["position error, median"] < 0.3
    assert (tmp_path / "days.png").exists()
