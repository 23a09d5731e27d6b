"""Recordings as MCAP: read back by the libraries that their users use, and what a killed writer leaves."""

import argparse
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.cli import parser
from daemon.recording import disk_writer, flight_recorder
from daemon.recording.retention import DUMP
from daemon.replay.results import Trajectory, kitti, tum
from daemon.snapshot import State
from daemon.system import console
from daemon.system.versions import build
from hal.replay.recording import Kind, open_recording
from hal.replay.report import LogReport
from tests.daemon.replay.room import read_tum
from tests.daemon.replay.test_dump import asked
from tests.daemon.replay.test_recorded_run import record

pytest.importorskip("rosbags", reason="pip install 'lumiloop[mcap]'")
from mcap.exceptions import McapError
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from taps.mcap import export
from taps.mcap.recover import NotMcap, recover
from taps.mcap.writer import McapFile
from taps.ros.messages import TOPICS, RosMessage

ROOT = Path(__file__).parents[3]
MOUNT = (0.1, -0.02, math.radians(30.0))


@pytest.fixture(scope="session")
def exported(recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The drive as MCAP, TUM and KITTI."""
    folder = tmp_path_factory.mktemp("exported")
    words = ["export", str(recording), "--mcap", str(folder / "drive.mcap"), "--online"]
    words += ["--tum", str(folder / "drive.tum"), "--kitti", str(folder / "drive.kitti")]
    assert parser.main(words) == console.OK
    return folder


def messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """By topic, as a ROS tool reads them: with the definitions that the file brings."""
    store = get_typestore(Stores.EMPTY)
    found: dict[str, list[tuple[int, Any]]] = {}
    with Reader(path) as reader:
        for connection in reader.connections:
            for name, types in get_types_from_msg(connection.msgdef.data, connection.msgtype).items():
                if name not in store.types:
                    store.register({name: types})
        for connection, stamp, data in reader.messages():
            found.setdefault(connection.topic, []).append((stamp, store.deserialize_cdr(data, connection.msgtype)))
    return found


def seconds(header: Any) -> float:
    return float(header.stamp.sec + 1e-9 * header.stamp.nanosec)


def yaw_of(q: Any) -> float:
    return 2.0 * math.atan2(q.z, q.w)


def test_a_guess_is_a_remark_in_tum_and_left_out_of_kitti() -> None:
    poses, states = np.zeros((3, 3)), np.array([State.TRACKING, State.LOST, State.DEGRADED])
    told = Trajectory(np.array([3.0, 2.0, 1.0]), poses, states)
    assert [line[:10] for line in tum(told).decode().splitlines()[1:]] == ["1.000000 0", "# LOST 2.0", "3.000000 0"]
    assert len(kitti(told).splitlines()) == 2
    assert len(kitti(Trajectory(told.stamps, poses)).splitlines()) == 3


def test_a_ros_tool_reads_the_drive(exported: Path) -> None:
    told = messages(exported / "drive.mcap")
    assert set(TOPICS) - set(told) == {"/lumiloop/lights", "/lumiloop/loop"}, "there is no photodiode, and no loop"
    stamps, poses = read_tum(exported / "drive.tum")
    placed = {round(seconds(m.header), 5): m.pose for _, m in told["/pose"]}
    for stamp, pose in zip(stamps.tolist(), poses.tolist(), strict=True):
        place = placed.get(round(stamp, 5))
        if place is not None:
            assert place.pose.position.x == pytest.approx(pose[0], abs=2e-6)
            assert math.remainder(yaw_of(place.pose.orientation) - pose[2], 2 * math.pi) == pytest.approx(0, abs=2e-6)
            assert place.covariance.reshape(6, 6)[5, 5] > 0.0
    assert sum(round(stamp, 5) in placed for stamp in stamps.tolist()) > 0.9 * len(stamps) > 60
    (scan, *_) = (m for _, m in told["/scan"])
    assert len(scan.ranges) == round((scan.angle_max - scan.angle_min) / scan.angle_increment) + 1 > 300
    assert 0.0 < scan.range_min < scan.range_max < 10.0
    assert scan.scan_time == pytest.approx(0.1, abs=0.01)
    (static, *_) = (m.transforms[0] for _, m in told["/tf_static"])
    moved, turned = static.transform.translation, yaw_of(static.transform.rotation)
    assert (moved.x, moved.y, turned) == pytest.approx(MOUNT)
    assert (static.header.frame_id, static.child_frame_id) == ("base_link", "laser")


def test_transforms_chain_to_the_pose_in_the_map(exported: Path) -> None:
    told = messages(exported / "drive.mcap")
    placed = {stamp: m.pose.pose for stamp, m in told["/pose"]}
    compared = 0
    for stamp, message in told["/tf"]:
        chain = {t.child_frame_id: t.transform for t in message.transforms}
        if "odom" in chain and stamp in placed:
            a, b, pose = chain["odom"], chain["base_link"], placed[stamp]
            c, s = math.cos(yaw_of(a.rotation)), math.sin(yaw_of(a.rotation))
            x = a.translation.x + c * b.translation.x - s * b.translation.y
            y = a.translation.y + s * b.translation.x + c * b.translation.y
            assert (x, y) == pytest.approx((pose.position.x, pose.position.y), abs=1e-9)
            compared += 1
    assert compared > 50


def test_the_map_is_the_room(exported: Path) -> None:
    told = messages(exported / "drive.mcap")
    grids = [m for _, m in told["/map"]]
    last = grids[-1]
    assert last.data.size == last.info.width * last.info.height
    assert set(np.unique(last.data).tolist()) == {-1, 0, 100}
    # beams of the last scan end on walls of the map
    scan, (_, pose) = told["/scan"][-1][1], told["/pose"][-1]
    yaw = yaw_of(pose.pose.pose.orientation)
    x = pose.pose.pose.position.x + MOUNT[0] * math.cos(yaw) - MOUNT[1] * math.sin(yaw)
    y = pose.pose.pose.position.y + MOUNT[0] * math.sin(yaw) + MOUNT[1] * math.cos(yaw)
    angle = yaw + MOUNT[2] + scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    hit = np.isfinite(scan.ranges)
    cells = last.data.reshape(last.info.height, last.info.width)
    column = ((x + scan.ranges * np.cos(angle))[hit] - last.info.origin.position.x) / last.info.resolution
    row = ((y + scan.ranges * np.sin(angle))[hit] - last.info.origin.position.y) / last.info.resolution
    at = [cells[r - 1 : r + 2, c - 1 : c + 2] for r, c in zip(row.astype(int), column.astype(int), strict=True)]
    assert np.mean([(near == 100).any() for near in at]) > 0.9


def test_diagnostics_say_the_state_and_raw_holds_the_devices_bytes(exported: Path) -> None:
    told = messages(exported / "drive.mcap")
    names = {status.name for _, m in told["/diagnostics"] for status in m.status}
    assert {"lumiloop: state", "lumiloop: cycle"} <= names
    raw = b"".join(m.data.tobytes() for _, m in told["/lumiloop/raw"] if m.kind == "rx")
    assert b"\n99b\n" in raw, "the head of a scan in SCIP"
    states = [m.state_name for _, m in told["/lumiloop/state"]]
    assert states[-1] in ("MAPPING", "TRACKING")


def test_bytes_after_the_last_scan_are_there_too(exported: Path, recording: Path) -> None:
    """Why there was no scan after it is in them."""
    passed = {Kind.RX, Kind.TX, Kind.OPEN, Kind.LOST, Kind.BAUD}
    said = [f for f in open_recording(recording).frames(LogReport()) if f.kind in passed and f.channel == 0]
    told = [m for _, m in messages(exported / "drive.mcap")["/lumiloop/raw"] if m.device == "lidar"]
    assert [m.data.tobytes() for m in told] == [f.payload for f in said]
    assert told[-1].kind == "lost", "the port is closed at the end"


def test_mcaps_own_library_finds_an_index_and_qos(exported: Path) -> None:
    with (exported / "drive.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count > 400
    channels = {channel.topic: channel.metadata["offered_qos_profiles"] for channel in summary.channels.values()}
    assert "durability: 1" in channels["/map"]
    assert "durability: 2" in channels["/scan"]


def whole_file(path: Path, count: int = 400) -> None:
    with McapFile(path) as file:
        fill(file, count)


def fill(file: McapFile, count: int) -> None:
    noise = np.random.default_rng(1)
    for number in range(count):
        file.write(RosMessage("/lumiloop/raw", 10**18 + number * 25_000_000, noise.bytes(200)))


def test_an_export_of_another_build_s_recording_says_so(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ["export", str(recording), "--tum", str(tmp_path / "drive.tum")]
    assert parser.main(words) == console.OK
    assert "recorded with" not in capsys.readouterr().err
    built = build()
    monkeypatch.setattr("daemon.system.versions.build", lambda: "of today")
    assert parser.main(words) == console.OK
    said = capsys.readouterr()
    assert f"{recording}: recorded with build {built}; this is build of today, so the replay may differ" in said.err
    assert said.out == ""


def test_an_export_that_is_told_to_stop_leaves_nothing_half_made(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stopped(args: argparse.Namespace) -> int:
        with export._replaced_on_success(args.tum) as part:
            part.write_bytes(b"half of it")
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(5.0)
        return 0

    monkeypatch.setattr(export, "_export", stopped)
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as ended:
        export.main(argparse.Namespace(log=tmp_path, source=tmp_path, mcap=None, kitti=None, tum=tmp_path / "a.tum"))
    assert ended.value.code == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(
    ("done", "seconds", "said"),
    [(0, 2.0, "export: 0 %"), (25, 10.0, "export: 25 %, 30 s left"), (2, 10.0, "export: 2 %, 8 min left")],
)
def test_an_export_says_how_long_it_goes_on(done: int, seconds: float, said: str) -> None:
    assert export.progress(done, 100, seconds) == said


def test_of_a_killed_writer_all_but_the_last_half_second_is_there(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    torn, whole = tmp_path / "torn.mcap", tmp_path / "whole.mcap"
    child = (
        "import os, time\nfrom pathlib import Path\n"
        "from taps.mcap.writer import McapFile\nfrom taps.ros.messages import RosMessage\n"
        f"file = McapFile(Path({str(torn)!r}))\n"
        "for n in range(400): file.write(RosMessage('/lumiloop/raw', 10**18 + n * 25_000_000, os.urandom(200)))\n"
        "print('written', flush=True)\ntime.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, "-c", child], cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        os.kill(process.pid, signal.SIGKILL)
    with torn.open("rb") as file, pytest.raises((McapError, ValueError)):
        make_reader(file).get_summary()
    assert parser.main(["export", str(torn), "--mcap", str(whole)]) == console.OK
    assert "its writer still runs or was killed" in capsys.readouterr().err
    (told,) = raw_messages(whole)
    assert 400 - 20 <= len(told) <= 400, "half a second at 40 Hz are 20"


def raw_messages(path: Path) -> list[list[int]]:
    with path.open("rb") as file:
        times: dict[str, list[int]] = {}
        for _, channel, message in make_reader(file).iter_messages():
            times.setdefault(channel.topic, []).append(message.log_time)
    return list(times.values())


def test_every_cut_and_every_damaged_place_is_survived(tmp_path: Path) -> None:
    source, target = tmp_path / "a.mcap", tmp_path / "b.mcap"
    whole_file(source, 120)
    data = source.read_bytes()
    rng = np.random.default_rng(2)
    saved = 0
    for _ in range(60):
        cut = bytearray(data[: int(rng.integers(0, len(data)))])
        if len(cut) and rng.random() < 0.5:
            cut[int(rng.integers(0, len(cut)))] ^= 1 << int(rng.integers(0, 8))
        source.write_bytes(bytes(cut))
        try:
            found = recover(source, target)
        except NotMcap:
            continue
        saved += 1
        (told,) = raw_messages(target)
        assert len(told) == found.messages <= 120
    assert saved > 30
    source.write_bytes(data)
    assert recover(source, target).sentence() == "120 messages over 3.0 s; the file was complete"


def test_what_is_no_mcap_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "a").write_bytes(b"nothing")
    with pytest.raises(NotMcap, match="its first bytes are wrong"):
        recover(tmp_path / "a", tmp_path / "b")
    assert parser.main(["export", str(tmp_path / "none"), "--mcap", str(tmp_path / "b")]) == console.FAILED
    assert parser.main(["export", str(tmp_path / "a")]) == console.USAGE
    said = capsys.readouterr().err
    assert "no output is named" in said
    assert not (tmp_path / "b").exists()


def test_an_mcap_file_is_neither_written_over_itself_nor_made_into_a_trajectory(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "drive.mcap"
    file.write_bytes((exported / "drive.mcap").read_bytes())
    before = file.read_bytes()
    assert parser.main(["export", str(file), "--mcap", str(tmp_path / "x" / ".." / "drive.mcap")]) == console.USAGE
    assert "name another file" in capsys.readouterr().err
    assert parser.main(["export", str(file), "--tum", str(tmp_path / "t")]) == console.USAGE
    assert "from the recording itself" in capsys.readouterr().err
    assert file.read_bytes() == before


@pytest.mark.parametrize("option", ["--tum", "--kitti", "--mcap"])
def test_an_export_never_writes_over_what_it_reads_nor_over_itself(
    option: str, recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Seen before anything is replayed, however the file is named."""
    shutil.copytree(recording, tmp_path / "copied")
    segment = min((tmp_path / "copied").rglob("*.lumirec"))
    before = segment.read_bytes()
    (tmp_path / "link").symlink_to(segment)
    for log in (segment, segment.parent):
        assert parser.main(["export", str(log), option, str(tmp_path / "link")]) == console.USAGE
        said = capsys.readouterr().err
        assert f"{option} {tmp_path / 'link'}: this is the input file; name another file" in said
    other = "--kitti" if option == "--tum" else "--tum"
    assert parser.main(["export", str(segment), option, str(tmp_path / "t"), other, f"{tmp_path}/./t"]) == console.USAGE
    assert "; name another file" in capsys.readouterr().err
    assert segment.read_bytes() == before
    assert not (tmp_path / "t").exists()
    assert parser.main(["export", str(segment), option, str(tmp_path / "none" / "t")]) == console.USAGE
    assert f"no folder {tmp_path / 'none'}; create it" in capsys.readouterr().err


def test_an_mcap_file_that_is_there_is_replaced_only_when_asked(
    exported: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """It may have been recorded live, and cannot be had again; a trajectory always can."""
    there = tmp_path / "there.mcap"
    there.write_bytes(b"a day of a robot")
    command = ["export", str(exported / "drive.mcap"), "--mcap", str(there)]
    assert parser.main(command) == console.USAGE
    assert "exists already; name another file, or replace it with --force" in capsys.readouterr().err
    assert there.read_bytes() == b"a day of a robot"
    assert parser.main([*command, "--force"]) == console.OK
    assert messages(there)


@pytest.mark.system
def test_a_dump_of_the_flight_recorder_opens_with_the_poses_that_were_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.002)
    monkeypatch.setattr(flight_recorder, "EVERY_S", 2.0)
    monkeypatch.setattr(flight_recorder, "LEAST_S", 2.0)
    bench = record(tmp_path / "rec", asked, keep_s=4.0)
    (dump,) = (tmp_path / "rec").glob(f"{DUMP}*-asked")
    assert parser.main(["export", str(dump), "--mcap", str(tmp_path / "dump.mcap")]) == console.OK
    told = messages(tmp_path / "dump.mcap")
    published = [(1.7e9 + one.t_mono, one.pose) for one in bench.snapshots if one.pose is not None]
    assert len(told["/pose"]) >= 30
    for _, message in told["/pose"]:
        stamp = seconds(message.header)
        t, (x, y, _) = min(published, key=lambda one: abs(one[0] - stamp))
        assert abs(t - stamp) < 1e-5, "a float of 1.7e9 s is good to less than a microsecond"
        assert (message.pose.pose.position.x, message.pose.pose.position.y) == (x, y)
    assert {"/scan", "/map", "/tf", "/lumiloop/raw"} <= set(told)


@pytest.mark.system
def test_evo_reads_the_trajectories(exported: Path, tmp_path: Path) -> None:
    """evo's own commands, as a person runs them; it is a tool, not a library of ours."""
    pytest.importorskip("evo", reason="pip install evo")
    env = {**os.environ, "HOME": str(tmp_path), "MPLBACKEND": "Agg"}
    stamps, poses = read_tum(exported / "drive.tum")
    way = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
    code = (
        "import json, sys\nfrom evo.tools import file_interface as f\n"
        "t, k = f.read_tum_trajectory_file(sys.argv[1]), f.read_kitti_poses_file(sys.argv[2])\n"
        "from rosbags.rosbag2 import Reader\n"
        "with Reader(sys.argv[3]) as bag: b = f.read_bag_trajectory(bag, '/pose')\n"
        "print(json.dumps([[x.num_poses, x.path_length, x.check()[0]] for x in (t, k, b)]))"
    )
    names = [str(exported / name) for name in ("drive.tum", "drive.kitti", "drive.mcap")]
    done = subprocess.run([sys.executable, "-c", code, *names], capture_output=True, text=True, env=env, check=True)
    told = json.loads(done.stdout.splitlines()[-1])
    for count, length, sound in told[:2]:
        assert (count, sound) == (len(stamps), True)
        assert length == pytest.approx(way, abs=1e-3)
    assert told[2][2] is True
    assert told[2][1] == pytest.approx(way, rel=0.1)
