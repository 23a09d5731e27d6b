"""The relations metric against what its paper says it is."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from tools import relations
from tools.relations import evaluate


def drive() -> tuple[np.ndarray, np.ndarray]:
    stamps = 1e9 + 0.1 * np.arange(200)
    yaw = 2 * np.sin(0.03 * np.arange(200))
    steps = 0.05 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return stamps, np.column_stack([np.cumsum(steps, axis=0), yaw])


def related(stamps: np.ndarray, poses: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    dx, dy = (poses[j] - poses[i])[:, :2].T
    return np.column_stack([stamps[i], stamps[j], c * dx + s * dy, c * dy - s * dx, poses[j, 2] - poses[i, 2]])


def test_truth_has_no_error_wherever_the_map_begins() -> None:
    stamps, poses = drive()
    i, j = np.random.default_rng(0).integers(0, 200, (2, 300))
    told = related(stamps, poses, i, j)
    turn = 1.234
    c, s = math.cos(turn), math.sin(turn)
    moved = np.column_stack(
        [c * poses[:, 0] - s * poses[:, 1] + 5, s * poses[:, 0] + c * poses[:, 1] - 3, poses[:, 2] + turn]
    )
    shuffled = np.random.default_rng(1).permutation(200)
    for path in (poses, moved):
        errors = evaluate(stamps[shuffled], path[shuffled], told)
        assert errors.missing == 0
        assert errors.translation_m.max() < 1e-9
        assert errors.rotation_deg.max() < 1e-6


def test_an_error_is_counted_once_and_in_its_unit() -> None:
    stamps, poses = drive()
    told = related(stamps, poses, np.array([3, 10]), np.array([50, 190]))
    told[0, 2] += 0.03
    told[0, 3] -= 0.04
    told[1, 4] += math.radians(2) + 2 * math.pi
    errors = evaluate(stamps, poses, told)
    assert errors.translation_m == pytest.approx([0.05, 0.0], abs=1e-9)
    assert errors.rotation_deg == pytest.approx([0.0, 2.0], abs=1e-6)
    assert errors.within(5.0).translation_m == pytest.approx([0.05])
    assert errors.beyond(5.0).rotation_deg == pytest.approx([2.0])


def test_a_stamp_without_a_pose_is_missing_not_guessed() -> None:
    stamps, poses = drive()
    told = related(stamps, poses, np.array([3, 10]), np.array([50, 190]))
    told[0, 0] += 0.05
    errors = evaluate(stamps, poses, told)
    assert (errors.missing, len(errors.translation_m)) == (1, 1)


def test_the_command_prints_all_local_and_global(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    stamps, poses = drive()
    rows = [
        f"{t:.6f} {x} {y} 0 0 0 {math.sin(a / 2)} {math.cos(a / 2)}" for t, (x, y, a) in zip(stamps, poses, strict=True)
    ]
    (tmp_path / "a.tum").write_text("# head\n" + "\n".join(rows) + "\n")
    told = related(stamps, poses, np.array([3, 4, 10, 11]), np.array([50, 51, 190, 191]))
    lines = [f"{a:.6f} {b:.6f} {x + 0.1} {y} 0 0 0 {yaw}" for a, b, x, y, yaw in told]
    (tmp_path / "a.relations").write_text("\n".join(lines) + "\n")
    monkeypatch.setattr(
        "sys.argv", ["relations", str(tmp_path / "a.tum"), str(tmp_path / "a.relations"), "--split", "10"]
    )
    assert relations.main() == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("all        n=    4   0.1000 +- 0.0000 m   0.000 +- 0.000 deg")
    assert said[1].startswith("local      n=    2   0.1000")
    assert said[3] == "missing    n=    0"


def test_a_missing_or_foreign_file_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    here, foreign = tmp_path / "here.tum", tmp_path / "foreign.relations"
    here.write_text("1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 1\n")
    foreign.write_text("not a number\n")
    for other, said in ((tmp_path / "nowhere", "nowhere: no such file"), (foreign, "foreign.relations: ")):
        monkeypatch.setattr("sys.argv", ["relations", str(here), str(other)])
        with pytest.raises(SystemExit) as stopped:
            relations.main()
        assert stopped.value.code == 2
        assert said in capsys.readouterr().err
