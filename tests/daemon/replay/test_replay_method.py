"""`lumiloop replay --method`: the paper's method and pIC from the command line, on logs and on a lit recording."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.cli import parser
from estimator.paper import METHODS
from tests.daemon.cli.test_replay import RESULTS
from tests.daemon.commissioning.recorded_drive import record
from tests.daemon.replay.room import Drive, carmen, drive, read_tum, relative
from tools.sim.scene import SimulatedScene

SECONDS = 16.0
OTHERS = [name for name in METHODS if name != "lumiloop"]


def replay(log: Path, out: Path, *options: str) -> dict[str, Any]:
    assert parser.main(["replay", str(log), "--out", str(out), *options]) == parser.OK
    summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    return summary


@pytest.fixture(scope="module")
def run() -> Drive:
    return drive()


@pytest.fixture(scope="module")
def log(run: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return carmen(tmp_path_factory.mktemp("log") / "room.log", run)


@pytest.fixture(scope="module")
def lit(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SimulatedScene]:
    folder = tmp_path_factory.mktemp("lit")
    return folder, record(folder, SECONDS)


def test_an_unknown_method_is_refused(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        parser.main(["replay", str(log), "--out", str(tmp_path), "--method", "slam"])
    assert ended.value.code == parser.USAGE
    said = capsys.readouterr().err
    assert "--method: 'slam' is unknown" in said
    assert all(name in said for name in METHODS)
    assert not list(tmp_path.iterdir())


def test_help_lists_the_methods(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser.main(["replay", "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert "--method {lumiloop,paper,pic}" in said
    assert all(what in said for what in METHODS.values())


@pytest.mark.jit
@pytest.mark.parametrize("method", OTHERS)
def test_a_log_without_light_by_another_method(method: str, log: Path, run: Drive, tmp_path: Path) -> None:
    summary = replay(log, tmp_path, "--method", method)
    assert summary["method"] == method
    assert summary["counts"]["matched"] == len(run.stamps) - 1
    assert {file.name for file in tmp_path.iterdir()} == RESULTS
    truth = relative(run.truth, run.truth[0])
    for name in ("trajectory.tum", "online.tum"):
        stamps, poses = read_tum(tmp_path / name)
        assert stamps == pytest.approx(run.stamps, abs=1e-6)
        off = np.hypot(*(relative(poses, poses[0]) - truth)[:, :2].T)
        assert off.max() < 0.15
    assert parser.main(["map", "verify", str(tmp_path / "map.lumimap")]) == parser.OK


@pytest.mark.jit
def test_the_default_is_named_and_the_same(log: Path, tmp_path: Path) -> None:
    assert replay(log, tmp_path / "a")["method"] == "lumiloop"
    assert replay(log, tmp_path / "b", "--method", "lumiloop")["method"] == "lumiloop"
    for name in RESULTS - {"timing.json"}:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


@pytest.mark.jit
def test_a_lit_recording_by_the_papers_method(lit: tuple[Path, SimulatedScene], tmp_path: Path) -> None:
    """In the frame of the survey, to the decimetres that Eq. 4 is good for; the recorded run is not compared."""
    folder, scene = lit
    summary = replay(folder, tmp_path, "--method", "paper")
    assert summary["method"] == "paper"
    assert summary["complete"] is True
    assert summary["recorded_run"] is None
    assert summary["counts"]["blocks"] > 200
    assert summary["motion"]["T_map_odom_jumps"] >= 1
    assert {file.name for file in tmp_path.iterdir()} == RESULTS
    stamps, poses = read_tum(tmp_path / "online.tum")
    assert np.isfinite(poses).all()
    late = stamps > stamps[-1] - 4.0
    off = poses[late] - scene.truth(stamps[late])
    assert np.hypot(*off[:, :2].T).max() < 0.8
    again = replay(folder, tmp_path / "again", "--method", "paper")
    assert again == summary
    for name in RESULTS - {"timing.json"}:
        assert (tmp_path / "again" / name).read_bytes() == (tmp_path / name).read_bytes(), name


@pytest.mark.jit
def test_a_lit_recording_by_pic(lit: tuple[Path, SimulatedScene], tmp_path: Path) -> None:
    """Light is left out: the map frame is that of the start."""
    folder, scene = lit
    summary = replay(folder, tmp_path, "--method", "pic")
    assert summary["method"] == "pic"
    assert summary["recorded_run"] is None
    stamps, poses = read_tum(tmp_path / "online.tum")
    np.testing.assert_allclose(poses[0], np.zeros(3), atol=0.02)
    truth = relative(scene.truth(stamps), scene.truth(stamps[:1])[0])
    assert np.hypot(*(relative(poses, poses[0]) - truth)[:, :2].T).max() < 0.2


@pytest.mark.jit
def test_a_match_of_another_method_is_in_the_journal_without_attempts(log: Path, tmp_path: Path) -> None:
    summary = replay(log, tmp_path, "--method", "paper", "--journal", "7")
    assert [one["match"] for one in summary["matches"]] == [7]
    entry = json.loads((tmp_path / "match-7.json").read_text())
    assert entry["result"]["ok"] is True
    assert entry["asked"] is None
    assert entry["attempts"] == []
