"""`lumiloop replay --journal`: matches as files, of foreign logs and of our own recordings, and wrong choices."""

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.cli import parser
from daemon.replay import match_journal, match_plot
from daemon.replay.match_journal import MOST, MOST_FAILED, BadChoice, Choice, MatchJournal, choice_of
from daemon.system import console
from estimator.result import Reason
from estimator.scan_matching import scan_matcher
from tests.daemon.cli.test_replay import RESULTS
from tests.daemon.replay.room import Drive, carmen, drive, read_tum
from tests.daemon.replay.test_recorded_lights import Recorded, calm, record
from tests.daemon.scenarios.test_lights import LIDAR

SCANS = 40


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    run = drive(SCANS)
    ranges = run.ranges.copy()
    ranges[20:25] = 81.9  # nothing returns: five scans without a point
    return carmen(tmp_path_factory.mktemp("log") / "room.log", Drive(run.truth, run.odometry, ranges, run.stamps))


@pytest.fixture(scope="module")
def out(log: Path) -> Path:
    folder = log.parent / "out"
    arguments = ["--journal", "1,12", "--journal-at", "3.05"]
    assert parser.main(["replay", str(log), "--out", str(folder), *arguments]) == console.OK
    return folder


def written(folder: Path, number: int) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / f"match-{number}.json").read_text())
    return content


def test_the_matches_asked_for_are_written_and_no_others(out: Path) -> None:
    names = {f"match-{n}.{kind}" for n in (1, 12, 32) for kind in ("json", "png")}  # 3.1 s is scan 32
    assert {file.name for file in out.iterdir()} == RESULTS | names


def test_a_match_is_all_there(out: Path) -> None:
    match = written(out, 12)
    assert (match["format"], match["version"]) == ("lumiloop-match", 1)
    assert match["seconds"] == pytest.approx(1.1, abs=1e-6)
    assert match["result"]["ok"]
    (first,) = match["attempts"]
    assert first["what"] == "first"
    assert first["found"] == pytest.approx(match["result"]["T_odom_base"], abs=1e-12)
    assert first["T_odom_base"] == match["asked"]["T_odom_base"]
    assert len(first["iterations"]) == match["result"]["iterations"]
    elements = np.array(match["asked"]["map"]["elements"])
    x, y, nx, ny = (match["asked"]["map"]["columns"].index(name) for name in ("x", "y", "normal_x", "normal_y"))
    for one in first["iterations"]:
        pair = one["pair"]
        point, element = np.array(first["points"])[pair["point"]], elements[pair["element"]]
        px, py, yaw = one["T_odom_base"]
        at_x = px + math.cos(yaw) * point[:, 0] - math.sin(yaw) * point[:, 1]
        at_y = py + math.sin(yaw) * point[:, 0] + math.cos(yaw) * point[:, 1]
        residual = element[:, nx] * (at_x - element[:, x]) + element[:, ny] * (at_y - element[:, y])
        np.testing.assert_allclose(residual, pair["residual_m"], atol=3e-5)  # the files are rounded to micrometres
        assert len(pair["point"]) * one["every"] == one["pairs"]
        assert sum(pair["fits"]) * one["every"] == one["inliers"]
        assert one["inliers"] <= one["pairs"] <= len(first["points"])


def same_pose(folder: Path, number: int) -> dict[str, Any]:
    """A match, once its pose and stamp have been found in the trajectory."""
    match = written(folder, number)
    lines = (folder / "trajectory.tum").read_text().splitlines()[1:]
    assert lines[match["pose"] - 1].startswith(f"{match['stamp']:.6f} ")
    return match


def test_a_match_names_its_line_of_the_trajectory(out: Path) -> None:
    stamps, poses = read_tum(out / "online.tum")
    for number in (1, 12, 32):
        match = same_pose(out, number)
        assert match["pose"] == number  # here every pose has a match, and the stamps ascend
        assert stamps[number - 1] - stamps[0] == pytest.approx(match["seconds"], abs=1e-5)
        np.testing.assert_allclose(poses[number - 1, :2], match["result"]["T_odom_base"][:2], atol=1e-5)


def test_where_stamps_step_back_the_line_is_that_of_the_stamp(tmp_path: Path) -> None:
    run = drive(20)
    stamps = run.stamps.copy()
    stamps[[9, 10]] = stamps[[10, 9]]
    log = carmen(tmp_path / "room.log", Drive(run.truth, run.odometry, run.ranges, stamps))
    assert parser.main(["replay", str(log), "--out", str(tmp_path / "out"), "--journal", "9,10,11"]) == console.OK
    assert [same_pose(tmp_path / "out", number)["pose"] for number in (9, 10, 11)] == [9, 11, 10]


async def lidar_away(bench: Recorded) -> None:
    """Light alone holds the pose while the lidar is unplugged."""
    await calm(bench)
    bench.opener.unplug(LIDAR)
    await bench.drive(2.0)
    bench.opener.plug(LIDAR, bench.device)
    await bench.drive(4.0)


def test_poses_that_light_alone_has_held_have_no_match(tmp_path: Path) -> None:
    record(tmp_path / "rec", lidar_away, lidar=True)
    folder = tmp_path / "out"
    words = ",".join(str(number) for number in range(1, 100, 14))
    assert parser.main(["replay", str(tmp_path / "rec"), "--out", str(folder), "--journal", words]) == console.OK
    numbers = sorted(int(file.stem.split("-")[1]) for file in folder.glob("match-*.json"))
    poses = [same_pose(folder, number)["pose"] for number in numbers]
    assert poses[-1] > numbers[-1], "poses without a match lie between"
    assert poses == sorted(set(poses))
    stamps, _ = read_tum(folder / "trajectory.tum")
    for number, pose in zip(numbers, poses, strict=True):
        match = written(folder, number)
        took = match["scan"]["t_end"] - written(folder, 1)["scan"]["t_end"]
        assert stamps[pose - 1] - stamps[poses[0] - 1] == pytest.approx(took, abs=1e-5)


def test_the_first_scan_has_nothing_to_match(out: Path) -> None:
    match = written(out, 1)
    assert (match["result"]["reason"], match["asked"], match["attempts"]) == ("NO_MAP", None, [])
    assert len(match["points"]) > 100
    assert match["light"] is None


def test_pictures_are_pictures(out: Path) -> None:
    from PIL import Image

    for number in (1, 12):
        with Image.open(out / f"match-{number}.png") as image:
            assert min(image.size) > 800
            assert len(image.convert("RGB").getcolors(1 << 24) or []) > 30


def test_a_journal_changes_no_result_and_is_the_same_twice(log: Path, out: Path, tmp_path: Path) -> None:
    assert parser.main(["replay", str(log), "--out", str(tmp_path / "plain")]) == console.OK
    for name in RESULTS - {"timing.json", "summary.json"}:
        assert (tmp_path / "plain" / name).read_bytes() == (out / name).read_bytes(), name
    plain, journalled = (json.loads((folder / "summary.json").read_text()) for folder in (tmp_path / "plain", out))
    assert plain.pop("matches") is None
    assert [match["match"] for match in journalled.pop("matches")] == [1, 12, 32]
    assert plain == journalled
    assert parser.main(["replay", str(log), "--out", str(tmp_path / "again"), "--journal", "12"]) == console.OK
    for kind in ("json", "png"):
        assert (tmp_path / "again" / f"match-12.{kind}").read_bytes() == (out / f"match-12.{kind}").read_bytes()


def test_what_failed_is_written_with_its_reason(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert parser.main(["replay", str(log), "--out", str(tmp_path), "--journal", "failed"]) == console.OK
    assert "5 matches failed" in capsys.readouterr().err
    numbers = sorted(int(file.stem.split("-")[1]) for file in tmp_path.glob("match-*.json"))
    assert numbers == [21, 22, 23, 24, 25]
    assert {written(tmp_path, number)["result"]["reason"] for number in numbers} == {"TOO_FEW_POINTS"}


def test_failures_are_bounded(capsys: pytest.CaptureFixture[str]) -> None:
    kept = MatchJournal(Choice(failed=True))
    kept.begins(0.0)
    failed = scan_matcher.no_match(np.zeros(3), 0, Reason.REJECTED)
    wanted = [kept.wants(float(k), failed) for k in range(MOST_FAILED + 5)]
    assert sum(wanted) == MOST_FAILED
    assert kept.sentences()[1:] == [
        f"{MOST_FAILED + 5} matches failed; the first {MOST_FAILED} of them are in the match trace"
    ]


def test_numbers_and_times_that_the_log_has_not_are_said(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["--journal", "2,900", "--journal-at", "77"]
    assert parser.main(["replay", str(log), "--out", str(tmp_path), *arguments]) == console.OK
    said = capsys.readouterr().err
    assert f"no match 900; the log has {SCANS}" in said
    assert "no match at or after 77 s" in said
    assert (tmp_path / "match-2.json").exists()
    assert "matches written: 1\n" in said
    (tmp_path / "match-notes.json").write_text("a person's own")
    assert parser.main(["replay", str(log), "--out", str(tmp_path), "--journal", "99999"]) == console.FAILED
    said = capsys.readouterr().err
    assert "matches written: 0; files of an earlier run removed: 2" in said
    assert "the log has none of the requested matches" in said
    assert {file.name for file in tmp_path.glob("match*")} == {"match-notes.json"}


def test_a_rejected_match_says_what_it_showed_and_what_was_asked(tmp_path: Path) -> None:
    run = drive(SCANS)
    ranges = run.ranges.copy()
    ranges[30] = np.random.default_rng(5).uniform(0.5, 7.0, ranges.shape[1])  # walls of no room
    log = carmen(tmp_path / "room.log", Drive(run.truth, run.odometry, ranges, run.stamps))
    assert parser.main(["replay", str(log), "--out", str(tmp_path / "out"), "--journal", "30,31"]) == console.OK
    assert written(tmp_path / "out", 30)["refusal"] is None
    match = written(tmp_path / "out", 31)
    assert match["result"]["reason"] == "REJECTED"
    refusal = match["refusal"]
    ways = refusal["ways"]
    met = any(refusal["share"] >= way["least_share"] and refusal["against"] <= way["most_against"] for way in ways)
    assert not met or refusal["held"] < refusal["least_held"]
    assert refusal["share"] == pytest.approx(match["result"]["inliers"] / match["result"]["queries"])


@pytest.mark.parametrize("words", ["0", "-1", "x", "1,,2", "1.5", "faild", "", ",".join(["1"] * (MOST + 1))])
def test_a_wrong_choice_is_wrong_usage(
    words: str, log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    arguments = ["replay", str(log), "--out", str(tmp_path / "none"), f"--journal={words}"]
    assert parser.main(arguments) == console.USAGE
    assert "--journal" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("seconds", [-1.0, math.nan, math.inf])
def test_a_time_must_be_one(seconds: float) -> None:
    with pytest.raises(BadChoice):
        choice_of(None, seconds)


def test_without_matplotlib_the_data_is_written_and_the_pictures_are_missed(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(match_plot, "find_spec", lambda name: None)
    assert parser.main(["replay", str(log), "--out", str(tmp_path), "--journal", "3"]) == console.OK
    assert "no plots of matches: matplotlib is not installed" in capsys.readouterr().err
    assert {file.name for file in tmp_path.glob("match*")} == {"match-3.json"}


def test_a_recording_with_lights_tells_what_light_said(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", calm, lidar=True)
    arguments = ["replay", str(tmp_path / "rec"), "--out", str(tmp_path / "out"), "--journal", "2"]
    assert parser.main(arguments) == console.OK
    assert bench.daemon.cycle.cycles > 10
    match = written(tmp_path / "out", 2)
    assert match["light"]["fix"] in {"NONE", "STARTING", "GOOD", "HELD", "AMBIGUOUS"}
    assert match["asked"]["most_iterations"] in (3, 7, 50)  # the recorded caps
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["recorded_run"]["differ"] == 0


def test_a_document_of_lamps_is_complete() -> None:
    from estimator.match_entry import LightPoint, LightSaid
    from estimator.result import Fix

    here, there = np.array((1.0, 2.0)), np.array((1.1, 2.0))
    lamps = (LightPoint(7, 70, there, here, here - there, 0.1), LightPoint(8, 80, None, here, None, None))
    content = match_journal._light(LightSaid(Fix.GOOD, np.zeros(3), 4, np.zeros(3), lamps))
    assert json.loads(json.dumps(content))["lamps"][0]["residual_xy"] == pytest.approx([-0.1, 0.0])
    assert content["lamps"][1]["keyframe_xy"] is None
