"""`lumiloop replay` and `lumiloop map export` from the command line: results, repeatability, bad input."""

import asyncio
import hashlib
import json
import math
from pathlib import Path

import numpy as np
import pytest

from daemon.app import Daemon, Environment
from daemon.cli import parser
from daemon.config.schema import Config, ModbusConfig
from daemon.replay.results import Trajectory
from daemon.runtime import warmup
from daemon.runtime.budget import FixedBudget
from daemon.runtime.cycle_parts import CycleRecord
from daemon.runtime.worker import CycleWorker
from daemon.system import console
from hal.clock import LoopClock
from hal.errors import DeviceFault
from hal.replay.carmen import read_carmen
from hal.replay.player import LogPlayer
from tests.commands import Command
from tests.daemon.replay.room import Drive, carmen, drive, read_tum, relative

RESULTS = {
    *("trajectory.tum", "online.tum", "loops.csv", "summary.json", "timing.json"),
    *("map.lumimap", "map.pgm", "map.yaml", "map.png"),
}


@pytest.fixture(scope="module")
def run() -> Drive:
    return drive()


@pytest.fixture(scope="module")
def log(run: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return carmen(tmp_path_factory.mktemp("log") / "room.log", run)


@pytest.fixture(scope="module")
def out(log: Path) -> Path:
    folder = log.parent / "out"
    assert parser.main(["replay", str(log), "--out", str(folder)]) == console.OK
    return folder


def summary_of(folder: Path) -> dict[str, dict[str, object]]:
    content: dict[str, dict[str, object]] = json.loads((folder / "summary.json").read_text())
    return content


def test_every_result_is_there_and_nothing_else(out: Path) -> None:
    assert {file.name for file in out.iterdir()} == RESULTS


def test_the_trajectory_is_the_drive(out: Path, run: Drive) -> None:
    truth = relative(run.truth, run.truth[0])
    wheels = relative(run.odometry, run.odometry[0])
    for name in ("trajectory.tum", "online.tum"):
        stamps, poses = read_tum(out / name)
        assert stamps == pytest.approx(run.stamps, abs=1e-6)
        found = relative(poses, poses[0])
        off = np.hypot(*(found - truth)[:, :2].T)
        drift = np.hypot(*(wheels - truth)[:, :2].T)
        assert off.max() < 0.05
        assert off[-1] < 0.25 * drift[-1]
        assert np.abs(np.remainder(found[:, 2] - truth[:, 2] + math.pi, 2 * math.pi) - math.pi).max() < math.radians(1)


def test_two_replays_write_identical_bytes(log: Path, out: Path, tmp_path: Path) -> None:
    assert parser.main(["replay", str(log), "--out", str(tmp_path)]) == console.OK
    for name in RESULTS - {"timing.json"}:
        assert (tmp_path / name).read_bytes() == (out / name).read_bytes(), name


def test_the_summary_counts_and_names_what_was_used(out: Path, log: Path, run: Drive) -> None:
    found = summary_of(out)
    assert found["complete"] is True
    assert found["counts"]["scans"] == found["counts"]["poses"] == found["counts"]["cycles"] == len(run.stamps)
    assert found["counts"]["matched"] == len(run.stamps) - 1  # the first has nothing to match
    assert found["log"]["sha256"] == hashlib.sha256(log.read_bytes()).hexdigest()
    way = np.hypot(*np.diff(run.truth[:, :2], axis=0).T).sum()
    assert found["motion"]["driven_m"] == pytest.approx(way, rel=0.03)
    step = np.hypot(*np.diff(run.truth[:, :2], axis=0).T).max()
    assert found["motion"]["T_odom_base_largest_step_m"] == pytest.approx(step, abs=0.03)
    assert found["config"]["lidar"]["mount"] == {"x": 0.0, "y": 0.0, "yaw": 0.0, "inverted": False}
    assert found["versions"]["numba"]
    assert found["recorded_run"] is None
    assert (out / "loops.csv").read_text() == "stamp,counter,keyframe_new,keyframe_old,residual_m\n"
    timing = json.loads((out / "timing.json").read_text())
    assert timing["log_seconds"] == pytest.approx(0.1 * (len(run.stamps) - 1), abs=0.01)
    assert timing["times_real_time"] > 0


def test_a_program_reads_the_summary(out: Path, log: Path, tmp_path: Path, done: Command) -> None:
    told = json.loads(done("replay", str(log), "--out", str(tmp_path / "json"), "--json"))
    assert told["schema"] == "lumiloop.replay/1"
    assert told == summary_of(out)


def test_the_map_has_walls_where_the_room_has_them(out: Path, run: Drive) -> None:
    from tests.daemon.replay.test_results import load_like_map_server

    cells, facts = load_like_map_server(out)
    x0, y0, _ = facts["origin"]  # type: ignore[misc]  # a list, as the loader asserts
    rows, columns = np.nonzero(cells == 100)
    start = run.truth[0]
    c, s = math.cos(start[2]), math.sin(start[2])
    px, py = x0 + 0.05 * (columns + 0.5), y0 + 0.05 * (rows + 0.5)
    x, y = start[0] + c * px - s * py, start[1] + s * px + c * py
    from tests.daemon.replay.room import WALLS

    distance = np.full(len(x), np.inf)
    for x1, y1, x2, y2 in WALLS.tolist():
        ex, ey = x2 - x1, y2 - y1
        along = np.clip(((x - x1) * ex + (y - y1) * ey) / (ex * ex + ey * ey), 0, 1)
        distance = np.minimum(distance, np.hypot(x - x1 - along * ex, y - y1 - along * ey))
    assert len(x) > 300
    assert np.quantile(distance, 0.95) < 0.08


@pytest.mark.virtual
async def test_the_log_as_a_device_of_the_daemon_gives_the_same_poses(log: Path, out: Path) -> None:
    """The player under the virtual loop, through daemon and pacemaker, against the replay's own drive of the cycle."""
    player = LogPlayer(read_carmen(log))
    poses: list[tuple[float, float, float]] = []

    def keep(record: CycleRecord) -> None:
        if record.scan is not None:
            assert record.snapshot.pose is not None
            poses.append(record.snapshot.pose)

    async def warm() -> None:
        warmup.load()

    clock = LoopClock(asyncio.get_running_loop())
    world = Environment(
        clock, make_lidar=lambda config, clock, opener: player.lidar, make_worker=CycleWorker,
        make_budget=FixedBudget, stopwatch=None, warm_up=warm, draw_map_id=lambda: 1,
    )  # fmt: skip
    daemon = Daemon(Config(modbus=ModbusConfig(port=0)), world)
    daemon.cycle.parts.tap = keep
    stop = asyncio.Event()
    running = asyncio.create_task(daemon.run(stop))
    await player.odometry.run(daemon.cycle.inbox.put_odometry)
    await asyncio.sleep(1.0)
    stop.set()
    await running
    _, replayed = read_tum(out / "online.tum")
    assert np.array(poses)[:, :2] == pytest.approx(replayed[:, :2], abs=1e-6)
    assert np.abs(np.sin(np.array(poses)[:, 2] - replayed[:, 2])).max() < 1e-6


def test_map_export_writes_the_same_map_alone(log: Path, out: Path, tmp_path: Path) -> None:
    assert parser.main(["map", "export", str(log), "--out", str(tmp_path)]) == console.OK
    assert {file.name for file in tmp_path.iterdir()} == {"map.pgm", "map.yaml", "map.png"}
    for file in tmp_path.iterdir():
        assert file.read_bytes() == (out / file.name).read_bytes()


def test_the_logs_mount_counts_unless_a_person_gives_one(tmp_path: Path, run: Drive) -> None:
    text = carmen(tmp_path / "plain.log", run).read_text()
    moved = []
    for line in text.splitlines():
        words = line.split()
        x, y, yaw = map(float, words[-9:-6])
        words[-9:-7] = [f"{x + 0.3 * math.cos(yaw):.6f}", f"{y + 0.3 * math.sin(yaw):.6f}"]
        moved.append(" ".join(words))
    log = tmp_path / "mounted.log"
    log.write_text("\n".join(moved[:3]) + "\n")
    assert parser.main(["replay", str(log), "--out", str(tmp_path / "a")]) == console.OK
    assert summary_of(tmp_path / "a")["config"]["lidar"]["mount"]["x"] == pytest.approx(0.3, abs=1e-5)  # type: ignore[index]  # plain data
    for number in (0.1, 0.0):
        given = ["--set", f"lidar.mount.x={number}"]
        assert parser.main(["replay", str(log), "--out", str(tmp_path / "b"), *given]) == console.OK
        assert summary_of(tmp_path / "b")["config"]["lidar"]["mount"]["x"] == number  # type: ignore[index]  # plain data


def test_stamps_that_run_backwards_stay_in_the_results(
    tmp_path: Path, run: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    shuffled = Drive(run.truth[:30], run.odometry[:30], run.ranges[:30], run.stamps[:30].copy())
    shuffled.stamps[[10, 20]] -= 0.35
    log = carmen(tmp_path / "a.log", shuffled)
    assert parser.main(["replay", str(log), "--out", str(tmp_path / "out")]) == console.OK
    stamps, poses = read_tum(tmp_path / "out" / "trajectory.tum")
    order = np.argsort(shuffled.stamps, kind="stable")
    assert stamps == pytest.approx(shuffled.stamps[order], abs=1e-6)
    truth = relative(run.truth[:30], run.truth[0])[order]
    assert np.hypot(*(poses - truth)[:, :2].T).max() < 0.05
    assert "backwards 2 times" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "the file is empty"),
        (b"#ROSBAG V2.0\n", "a ROS 1 bag"),
        (b"\x89MCAP0\r\n", "an MCAP file"),
        (b"PK\x03\x04 and so on", "a zip or npz archive"),
        (b"1 2 3 4\n5 6 7 8\n", "not a CARMEN log"),
    ],
)
def test_a_log_of_another_kind(tmp_path: Path, refused: Command, content: bytes, says: str) -> None:
    path = tmp_path / "a.bin"
    path.write_bytes(content)
    said = refused("replay", str(path), "--out", str(tmp_path / "out"))
    assert says in said
    assert str(path) in said


def test_a_missing_log_and_an_output_that_is_a_file(
    tmp_path: Path, log: Path, capsys: pytest.CaptureFixture[str], refused: Command
) -> None:
    assert parser.main(["replay", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == console.FAILED
    assert "none: no such file (check the path)" in capsys.readouterr().err
    (tmp_path / "file").write_text("")
    assert "is a file; name a folder" in refused("replay", str(log), "--out", str(tmp_path / "file"))


def test_a_log_that_is_mostly_guessed_says_so_in_its_last_line(
    tmp_path: Path, log: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def lost(told: Trajectory) -> list[str]:
        return ["LOST" if number < 0.3 * len(told.stamps) else "" for number in range(len(told.stamps))]

    monkeypatch.setattr(Trajectory, "guesses", lost)
    assert parser.main(["replay", str(log), "--out", str(tmp_path)]) == console.OK
    assert "30 % of the poses are unconfirmed; do not use" in capsys.readouterr().err.splitlines()[-1]
    counts = summary_of(tmp_path)["counts"]
    assert counts["guesses"] == pytest.approx(0.3 * float(str(counts["poses"])), abs=1.0)


@pytest.mark.parametrize(
    ("trouble", "code", "says"),
    [
        (KeyboardInterrupt(), console.INTERRUPTED, "interrupted"),
        (DeviceFault("room.log", "the disk has gone", "connect it"), console.FAILED, "the disk has gone"),
    ],
)
def test_what_ends_a_replay_early_leaves_what_was_computed(
    tmp_path: Path,
    log: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trouble: BaseException,
    code: int,
    says: str,
) -> None:
    from daemon.replay.sources import CarmenSource

    whole = CarmenSource.events

    def cut(self: CarmenSource):  # type: ignore[no-untyped-def]  # a generator in a test
        for number, event in enumerate(whole(self)):
            if number == 40:
                raise trouble
            yield event

    monkeypatch.setattr(CarmenSource, "events", cut)
    assert parser.main(["replay", str(log), "--out", str(tmp_path)]) == code
    said = capsys.readouterr().err
    assert says in said
    assert "the results up to there are in" in said
    assert len(read_tum(tmp_path / "trajectory.tum")[0]) == 20
    assert summary_of(tmp_path)["complete"] is False


def test_a_capture_without_scans_is_no_success(tmp_path: Path, refused: Command) -> None:
    path = tmp_path / "a.logr"
    path.write_bytes(bytes(7) + b"\x05" + (6).to_bytes(4, "big") + b"VV\n00P")
    assert "does not contain a scan that gave a pose" in refused("replay", str(path), "--out", str(tmp_path / "out"))


def test_the_real_capture_gives_its_poses(log_root: Path, tmp_path: Path) -> None:
    path = log_root / "scip" / "example_urg_04lx.logr"
    assert parser.main(["replay", str(path), "--out", str(tmp_path)]) == console.OK
    assert summary_of(tmp_path)["counts"]["poses"] == summary_of(tmp_path)["counts"]["scans"] > 0  # type: ignore[operator]  # plain data
