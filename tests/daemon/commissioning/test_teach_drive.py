"""From bytes on the wire to a survey: a recorded drive of the whole daemon through both commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from daemon.cli import parser
from daemon.config.loader import load
from daemon.config.survey_loader import read_survey
from daemon.system import console
from tests.daemon.commissioning.recorded_drive import record
from tools.sim.light_harness import BUS


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_recorded_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = record(tmp_path / "teach", 100.0)
    out = tmp_path / "lights.toml"
    assert parser.main(["survey", str(tmp_path / "teach"), "--height", "2.9", "--out", str(out)]) == console.OK
    assert scene.light is not None
    placed = {f.code: at for f, at in zip(scene.light.ceiling.fixtures, scene.light.ceiling.placed, strict=True)}
    start = scene.drive.pose(np.zeros(1))[0]
    c, s = np.cos(start[2]), np.sin(start[2])
    errors = []
    for lamp in read_survey(out).lamps:
        x, y = start[0] + c * lamp.x - s * lamp.y, start[1] + s * lamp.x + c * lamp.y
        if abs(x) < 5.0 and abs(y) < 5.0:
            errors.append(float(np.hypot(x - placed[lamp.code][0], y - placed[lamp.code][1])))
    assert len(errors) == 16
    assert np.median(errors) < 0.1
    capsys.readouterr()
    better = tmp_path / "better.toml"
    assert parser.main(["calibrate", str(tmp_path / "teach"), "--out", str(better)]) == console.OK
    said = capsys.readouterr().out
    assert "not determined by this drive" in said
    assert len(read_survey(better).lamps) == len(placed)
    wheels = ["--out", str(tmp_path / "robot.toml")]
    assert parser.main(["calibrate", str(tmp_path / "teach"), "--odometry", "--lidar-mount", *wheels]) == console.OK
    assert load(tmp_path / "robot.toml").photodiode.bus == BUS
