"""The commands `calibrate` and `survey`: what they say, write and refuse; drives are made without a recording here."""

from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest

import daemon.cli.calibrate
import daemon.cli.survey
from daemon.cli import inputs, parser
from daemon.commissioning.teach_drive import Drive, heard, poses_at
from daemon.config.loader import load
from daemon.config.residual_file import ResidualError, read_residuals, write_residuals
from daemon.config.schema import Config, LidarConfig, Mount
from daemon.config.survey_loader import read_survey, residuals_beside, write_survey
from daemon.replay.results import Trajectory
from daemon.system import console
from estimator.cdma.air_interface import PROFILE_B
from estimator.cdma.epoch import BlockFlag, LightEpoch
from estimator.light_filter.lambertian import expected
from estimator.light_filter.residual_map import ResidualMap
from estimator.numerics.se2 import between, compose
from hal.errors import DataInvalid
from tests.commands import Command
from tests.estimator.calibration.test_odometry_calibration import TRUE
from tests.estimator.calibration.test_odometry_calibration import drive as wheels_and_laser
from tests.estimator.teach import drive as way
from tests.estimator.teach import nominal, real

T0 = 1.7e9


@pytest.fixture(scope="module")
def taught() -> Drive:
    """A drive whose map begins elsewhere than the survey, and is turned."""
    survey = nominal(2)
    truth = real(survey, 1)
    t, pose = way(truth, 2, 2500)
    c, s = np.cos(0.4), np.sin(0.4)
    x, y = pose[:, 0] - 1.0, pose[:, 1] - 0.5
    there = np.column_stack((c * x - s * y, s * x + c * y, pose[:, 2] + 0.4))
    drive = Drive(Path("teach"), Trajectory(T0 + t, there), survey)
    codes = np.array([lamp.code for lamp in survey.lamps])
    g = np.random.default_rng(3)
    for at, where in zip(t, pose, strict=True):
        a = expected(truth.lamps, truth, where).amplitude * np.exp(0.01 * g.normal(size=len(codes)))
        n = len(codes)
        epoch = LightEpoch(
            at, at, codes, a, (1e-3 * a) ** 2, np.zeros(n, np.int64), (None,) * n, BlockFlag.NONE, 0.0, None
        )
        drive.epochs.append((T0 + at, epoch))
    wheels = np.column_stack((T0 + t, 0.98 * there[:, :2], np.unwrap(there[:, 2])))
    drive.readings = wheels
    return drive


@pytest.fixture(autouse=True)
def there(monkeypatch: pytest.MonkeyPatch) -> None:
    """A recording called ``teach`` can be opened."""
    opened = inputs.log
    monkeypatch.setattr(
        inputs, "log", lambda args: setattr(args, "source", None) if args.log == Path("teach") else opened(args)
    )


@pytest.fixture
def played(taught: Drive, monkeypatch: pytest.MonkeyPatch) -> Drive:
    """Both commands get that drive, whatever recording is named."""
    monkeypatch.setattr(daemon.cli.calibrate, "read_drive", lambda *_: taught)
    monkeypatch.setattr(daemon.cli.survey, "read_drive", lambda *_: taught)
    return taught


@pytest.mark.jit
def test_calibrate_writes_a_better_survey_with_its_map(
    played: Drive, tmp_path: Path, done: Command, refused: Command
) -> None:
    out = tmp_path / "new.toml"
    said = done("calibrate", "teach", "--out", str(out))
    assert "before" in said
    assert "rx_slope_x" in said
    assert "yaw -22.9" in said  # -0.4 rad
    truth = real(nominal(2), 1)
    survey = read_survey(out)
    for found, lamp in zip(survey.lamps, truth.lamps, strict=True):
        assert abs(np.log(found.power_w / lamp.power_w)) < 0.1
        assert abs(found.slope_x - lamp.slope_x) < 0.02
    assert "order +-" in out.read_text()
    assert read_residuals(residuals_beside(out), survey) is not None
    assert out.with_suffix(".png").stat().st_size > 10_000
    # nothing is overwritten unasked, and that is said before any work
    assert "--force" in refused("calibrate", "teach", "--out", str(out))


@pytest.mark.jit
def test_survey_writes_lamps_with_uncertainties(played: Drive, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "lights.toml"
    assert "sigma m" in done("survey", "teach", "--height", "2.9", "--out", str(out))
    found = {lamp.code: lamp for lamp in read_survey(out).lamps}
    lamps = nominal(2).lamps
    assert set(found) == {lamp.code for lamp in lamps}
    apart = np.hypot(found[0].x - found[7].x, found[0].y - found[7].y)
    assert apart == pytest.approx(2.5, abs=0.1)
    assert "passed at" in out.read_text()
    assert parser.main(["survey", "teach", "--out", str(out)]) == console.FAILED


@pytest.fixture
def driven(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Drive:
    """Wheels that say too little, and a laser that sits elsewhere than its recording's configuration says."""
    wheels, laser = wheels_and_laser(1)
    configured = Mount(x=0.28, y=0.0, yaw=0.0, inverted=True)
    t, (x, y, yaw) = T0 + 0.05 * np.arange(len(wheels)), (configured.x, configured.y, 0.0)
    poses = np.array([compose(seen, between(np.array((x, y, yaw)), np.zeros(3))) for seen in laser])
    drive = Drive(Path("teach"), Trajectory(t, poses), nominal(2))
    drive.readings = np.column_stack((t, wheels))
    drive.config = Config(name="r7", lidar=LidarConfig(device="/dev/ttyACM3", mount=configured))
    monkeypatch.setattr(daemon.cli.calibrate, "read_drive", lambda *_: drive)
    monkeypatch.chdir(tmp_path)
    return drive


def test_the_mount_is_written_as_a_configuration_with_a_picture(driven: Drive, tmp_path: Path, done: Command) -> None:
    said = done("calibrate", "teach", "--lidar-mount")
    out = tmp_path / "lumiloop-calibrated.toml"
    written = load(out)
    mount = written.lidar.mount
    assert (mount.x, mount.y) == pytest.approx(TRUE[3:5], abs=0.01)
    assert mount.yaw == pytest.approx(np.degrees(TRUE[5]), abs=0.3)
    assert mount.inverted
    before = driven.config
    assert msgspec.structs.replace(written, lidar=before.lidar) == before
    assert msgspec.structs.replace(written.lidar, mount=before.lidar.mount) == before.lidar
    robot = tmp_path / "robot.toml"
    robot.write_text("[lidar]\nmount = { x = 9.0, y = 9.0, yaw = 9.0, inverted = true }  # as in the first steps\n")
    (command,) = [row for row in said.splitlines() if row.startswith("lumiloop config set ")]
    assert parser.main([*command.split()[1:], "--config", str(robot)]) == console.OK
    assert load(robot).lidar.mount == mount
    assert "scale" not in out.read_text()
    assert out.with_suffix(".png").stat().st_size > 10_000
    assert parser.main(["check", str(out)]) == console.OK


def test_what_the_wheels_told_is_at_the_head_of_the_configuration(driven: Drive, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "robot.toml"
    said = done("calibrate", "teach", "--odometry", "--out", str(out))
    assert "mount" not in said
    head = [line for line in out.read_text().splitlines() if line.startswith("#")]
    for name, true in zip(("scale", "turn", "drift"), (TRUE[0], TRUE[1], np.degrees(TRUE[2])), strict=True):
        (told,) = (line for line in head if line.startswith(f"# {name} "))
        value, sigma = told.removeprefix(f"# {name}").removesuffix(" deg/m").split("+-")
        assert float(value) == pytest.approx(true, abs=5.0 * float(sigma) + 1e-4)
        assert told[2:] in said
    assert load(out) == driven.config, "nothing but the remarks"


def test_a_configuration_is_not_overwritten_unasked(
    driven: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Command
) -> None:
    out = tmp_path / "robot.toml"
    out.write_text("# hall 3\nname = 'mine'\n")
    words = ["calibrate", "teach", "--lidar-mount", "--out", str(out)]
    assert "--force" in refused(*words)
    assert out.read_text() == "# hall 3\nname = 'mine'\n"
    assert [file.name for file in tmp_path.iterdir()] == ["robot.toml"]
    assert parser.main([*words, "--force"]) == console.OK
    assert load(out).name == "r7"
    assert "# hall 3\n" in out.read_text(), "comments of the file stay"
    assert out.read_text().startswith("# Configuration of drive")
    assert "cannot write" in refused(*words[:-1], str(tmp_path / "nowhere" / "robot.toml"))


def test_what_is_missing_is_said(
    played: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Command
) -> None:
    out = ["--out", str(tmp_path / "x.toml")]
    for change, words in (
        ({"survey": replace(played.survey, lamps=())}, "the recording has no survey; name one with --survey"),
        ({"epochs": []}, "no lamp was decoded in the recording"),
        ({"epochs": played.epochs[:10]}, "--start X Y DEGREES"),
    ):
        fields = {name: getattr(played, name) for name in ("path", "poses", "survey", "epochs", "readings")}
        other = Drive(**{**fields, **change})
        monkeypatch.setattr(daemon.cli.calibrate, "read_drive", lambda *_, other=other: other)
        assert words in refused("calibrate", "teach", *out)
    monkeypatch.setattr(daemon.cli.calibrate, "read_drive", lambda *_: Drive(Path("t"), played.poses, played.survey))
    assert "the recording has no odometry" in refused("calibrate", "teach", "--odometry")


def test_a_survey_for_another_air_interface_is_refused(
    played: Drive, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    other = Drive(played.path, played.poses, played.survey, played.epochs, profile=PROFILE_B)
    monkeypatch.setattr(daemon.cli.calibrate, "read_drive", lambda *_: other)
    path = tmp_path / "lights.toml"
    path.write_text("lamp = [ { lamp_id = 7, code = 65, x = 0.0, y = 0.0, z = 2.6 } ]")
    assert (
        parser.main(["calibrate", "teach", "--survey", str(path), "--out", str(tmp_path / "x.toml")]) == console.FAILED
    )
    assert "lamp 7: code 65 is not in profile B, which has codes 0 to 64" in capsys.readouterr().err


def test_no_recording(tmp_path: Path, refused: Command) -> None:
    assert "none" in refused("calibrate", str(tmp_path / "none"), "--out", str(tmp_path / "x.toml"))
    assert parser.main(["survey", str(tmp_path / "none"), "--out", str(tmp_path / "x.toml")]) == console.FAILED


def test_strengths_without_a_pose_near_are_left_out(taught: Drive) -> None:
    stamps = np.array([0.0, 0.1, 5.0, 5.1])
    poses = np.array([(0.0, 0, 3.1), (1.0, 0, -3.1), (2.0, 0, 0), (3.0, 0, 0)])
    found, known = poses_at(Trajectory(stamps, poses), np.array([0.05, 2.0, 5.05, 9.0]))
    assert known.tolist() == [True, False, True, False]
    assert abs(abs(found[0, 2]) - np.pi) < 0.05  # the short way round
    with pytest.raises(DataInvalid, match=r"photodiode\.bus"):
        heard(Drive(Path("t"), taught.poses, taught.survey))


def small_map() -> ResidualMap:
    return ResidualMap((1, 2), np.ones((2, 4)), np.ones((2, 3, 3)), np.full((2, 3, 3), 0.1), 0.02)


def test_a_map_reads_back_and_what_is_not_one_is_refused(tmp_path: Path) -> None:
    survey, path = nominal(2), tmp_path / "a.residuals.npz"
    assert read_residuals(path, survey) is None
    write_residuals(path, small_map(), survey)
    back = read_residuals(path, survey)
    assert back is not None
    assert back.lamp_ids == (1, 2)
    assert np.array_equal(back.mean, small_map().mean)
    with pytest.raises(ResidualError, match="another survey"):
        read_residuals(path, replace(survey, floor=0.03))
    data = bytearray(path.read_bytes())
    for at in range(40, len(data), 97):
        broken = bytearray(data)
        broken[at] ^= 0x55
        path.write_bytes(bytes(broken))
        try:
            same = read_residuals(path, survey)
        except ResidualError:
            continue
        assert same is not None  # a byte that nobody reads
        assert np.array_equal(same.mean, small_map().mean)
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ResidualError, match="not a residual map"):
        read_residuals(path, survey)
    with pytest.raises(ResidualError, match="cannot write"):
        write_residuals(tmp_path / "no" / "x.npz", small_map(), survey)


def test_survey_beside_which_it_lies(tmp_path: Path) -> None:
    path = tmp_path / "hall.toml"
    write_survey(path, nominal(2))
    assert residuals_beside(path).name == "hall.residuals.npz"
