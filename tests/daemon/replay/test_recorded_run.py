"""A recorded run, replayed: the whole daemon in virtual time, its recording, and the same poses to the last bit."""

import asyncio
import itertools
import json
import math
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from daemon.app import Daemon, Environment
from daemon.cli import parser
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount
from daemon.health.faults import Fault
from daemon.health.reasons import Reason
from daemon.maps.store import Start
from daemon.recording.recorder import CycleEntry, Recorder, decode_cycle
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from daemon.system import console
from estimator.measurements import Command, Limits, Order
from estimator.numerics import se2
from hal.clock import LoopClock, run_virtual
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import URG_04LX, URG_04LX_UG01, LidarModel
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from hal.imu import RawImu
from hal.odometry import RawOdometry
from hal.replay.recording import Kind, open_recording, pack_frame, pack_head
from hal.replay.report import LogReport
from tests.daemon.replay.room import read_tum
from tests.daemon.support.whole_daemon import during

USB, SERIAL = "/dev/ttyACM0", "/dev/ttyUSB0"
SETTINGS = Config(lidar=LidarConfig(device=USB, mount=Mount(0.1, -0.02, 30.0)), modbus=ModbusConfig(port=0))


class UnevenBudget(FixedBudget):
    """Caps that change from cycle to cycle, as measured ones do."""

    def __init__(self) -> None:
        super().__init__()
        self._caps = itertools.cycle([Limits(50, 100_000, True), Limits(3, 120, False), Limits(7, 333, True)])

    def limits(self, budget_us: float, light: bool = False, carrier: bool = False) -> Limits:
        return next(self._caps)


def configured(device: str) -> Config:
    return msgspec.structs.replace(SETTINGS, lidar=msgspec.structs.replace(SETTINGS.lidar, device=device))


@dataclass
class Bench:
    """A recorded daemon with its lidar and its inputs."""

    folder: Path
    device_name: str = USB
    start: Start | None = None
    keep_s: float = math.inf
    snapshots: list[Snapshot] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.loop = asyncio.get_running_loop()
        self.clock = LoopClock(self.loop, utc_at_zero=1.7e9)
        model: LidarModel = URG_04LX_UG01 if self.device_name == USB else URG_04LX
        self.room = Room(model)
        self.device = FakeHokuyo(model, self.room)
        self.opener = FakeOpener(self.clock)
        self.opener.plug(self.device_name, self.device)
        self.faults = FaultSchedule({"lidar": self.device})
        settings = configured(self.device_name)
        self.recorder = Recorder(self.folder, settings, self.clock, start=self.start, keep_s=self.keep_s)
        self.daemon = Daemon(settings, self._world(), self.recorder)
        inbox = self.daemon.cycle.inbox
        self.put_odometry = self.recorder.on_odometry(inbox.put_odometry)
        self.put_imu = self.recorder.on_imu(inbox.put_imu)

    def _world(self) -> Environment:
        async def warm() -> None:
            from daemon.runtime.warmup import load

            load()

        return Environment(
            self.clock,
            opener=self.opener,
            make_worker=CycleWorker,
            make_budget=UnevenBudget,
            stopwatch=None,
            warm_up=warm,
            sinks=(self.snapshots.append,),
            draw_map_id=lambda: 1,
            start=self.start,
        )

    async def drive(self, seconds: float) -> None:
        """Odometry at 33 Hz and a gyro at 50 Hz, neither in step with the lidar."""
        start = self.room.pose(np.array([self.loop.time()]))[0]
        before = 0.0
        for tick in range(round(seconds * 100)):
            await asyncio.sleep(0.01)
            t = self.loop.time()
            x, y, yaw = se2.between(start, self.room.pose(np.array([t]))[0]).tolist()
            if tick % 3 == 0:
                self.put_odometry(RawOdometry(t, t - 0.004, 1.02 * x, y, yaw))
            if tick % 2 == 0:
                self.put_imu(RawImu(t, t, (yaw - before) / 0.02))
                before = yaw


def record(
    folder: Path,
    scenario: Callable[[Bench], Awaitable[None]],
    device: str = USB,
    start: Start | None = None,
    keep_s: float = math.inf,
) -> Bench:
    async def go() -> Bench:
        bench = Bench(folder, device, start, keep_s)
        await during(bench.daemon, scenario(bench))
        return bench

    return run_virtual(go())


def replay(folder: Path, out: Path, *options: str) -> dict[str, dict[str, object]]:
    assert parser.main(["replay", str(folder), "--out", str(out), *options]) == console.OK
    summary: dict[str, dict[str, object]] = json.loads((out / "summary.json").read_text())
    return summary


def assert_the_same(summary: dict[str, Any], cycles: int) -> None:
    """Every cycle was compared, with its state and reason, and none differs."""
    said = dict(summary["recorded_run"])
    said.pop("published_with")
    assert said == {"cycles": cycles, "differ": 0, "first_difference": "", "judged": cycles}


async def calm(bench: Bench) -> None:
    await bench.drive(8.0)


async def patient(bench: Bench) -> None:
    """A serial sensor is first looked for at every rate, and then told to talk faster."""
    await bench.drive(30.0)


FAULTS = """
[[fault]]
what = "bit_flip"
share = 0.3
for = 1.5
[[fault]]
what = "set_clock"
when = 2.0
[[fault]]
what = "stall"
when = 2.3
for = 0.5
"""


async def eventful(bench: Bench) -> None:
    """Damage on the line, the plug pulled, a reboot, and orders from a person."""
    await bench.drive(3.0)
    bench.faults.load(FAULTS)
    await bench.drive(3.0)
    bench.opener.unplug(USB)
    await bench.drive(2.0)
    bench.opener.plug(USB, bench.device)
    await bench.drive(3.0)
    inbox = bench.daemon.cycle.inbox
    inbox.put_command(Command(bench.loop.time(), Order.SET_POSE, np.array((5.0, -3.0, 2.0))))
    await bench.drive(2.0)
    inbox.put_command(Command(bench.loop.time(), Order.RESET))
    await bench.drive(2.0)
    bench.device.power_on()
    await bench.drive(5.0)


@pytest.mark.parametrize(("scenario", "device"), [(calm, USB), (patient, SERIAL), (eventful, USB)])
def test_the_replay_gives_the_same_poses_to_the_last_bit(
    tmp_path: Path, scenario: Callable[[Bench], Awaitable[None]], device: str
) -> None:
    bench = record(tmp_path / "rec", scenario, device)
    summary = replay(tmp_path / "rec", tmp_path / "out")
    assert_the_same(summary, bench.daemon.cycle.cycles)
    assert summary["counts"]["scans"] >= bench.daemon.lidar.status.scans > 30
    assert summary["config"]["lidar"]["mount"] == {"x": 0.1, "y": -0.02, "yaw": 30.0, "inverted": False}  # type: ignore[index]  # plain data
    stamps, poses = read_tum(tmp_path / "out" / "online.tum")
    posed = np.array([(1.7e9 + snapshot.t_mono, *snapshot.pose) for snapshot in bench.snapshots if snapshot.pose])
    for stamp, pose in zip(stamps.tolist(), poses, strict=True):
        told = posed[np.abs(posed[:, 0] - stamp) < 2e-6]  # cycles without a scan may carry the same instant
        off = np.column_stack([told[:, 1:3] - pose[:2], np.sin(told[:, 3] - pose[2])])
        assert np.abs(off).max(axis=1).min() < 2e-6


async def pulled(bench: Bench) -> None:
    """The lidar's plug, for a while."""
    await bench.drive(4.0)
    bench.opener.unplug(USB)
    await bench.drive(4.0)
    bench.opener.plug(USB, bench.device)
    await bench.drive(4.0)


def aged(folder: Path) -> None:
    """Make the cycles of a recording those of before reason and faults were kept."""
    (segment,) = folder.rglob("*.lumirec")
    recording = open_recording(folder)
    frames = [pack_head(recording.header)]
    for frame in recording.frames(LogReport()):
        payload = frame.payload
        if frame.kind == Kind.CYCLE:
            entry = msgspec.msgpack.decode(payload)
            payload = msgspec.msgpack.encode(entry[: CycleEntry.__struct_fields__.index("reason")])
        frames.append(pack_frame(frame.kind, frame.channel, frame.t_mono, payload))
    segment.write_bytes(b"".join(frames))


def test_what_was_published_is_kept_and_what_the_driver_had_to_say_is_repeated(tmp_path: Path) -> None:
    """A lidar that cannot be opened has a reason, and a fault, that its bytes do not tell."""
    bench = record(tmp_path / "rec", pulled)
    entries = [
        decode_cycle(frame.payload)
        for frame in open_recording(tmp_path / "rec").frames(LogReport())
        if frame.kind == Kind.CYCLE
    ]
    ran = [one for one in bench.snapshots if one.seq > len(bench.snapshots) - len(entries)]
    assert [(entry.state, entry.reason) for entry in entries] == [(one.state, one.reason) for one in ran]
    assert [entry.faults for entry in entries] == [one.condition.faults for one in ran if one.condition is not None]
    assert (State.NO_LIDAR, Reason.LIDAR_UNREACHABLE) in {(entry.state, entry.reason) for entry in entries}
    summary = replay(tmp_path / "rec", tmp_path / "out")
    assert_the_same(summary, len(entries))
    missing = sum(Fault.LIDAR_MISSING in entry.faults for entry in entries)
    assert summary["recorded_run"]["published_with"]["101"] == missing > 20  # type: ignore[index]  # plain data


@pytest.mark.parametrize("other", [{"state": State.LOST}, {"reason": Reason.PAUSED}])
def test_a_state_or_reason_that_is_not_the_recorded_one_is_a_difference(
    tmp_path: Path, other: dict[str, int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """In one cycle of many."""
    record(tmp_path / "rec", calm)

    def decode(payload: bytes) -> CycleEntry:
        entry = decode_cycle(payload)
        return msgspec.structs.replace(entry, **other) if entry.cycle == 40 else entry

    monkeypatch.setattr("daemon.replay.sources.decode_cycle", decode)
    said = replay(tmp_path / "rec", tmp_path / "out")["recorded_run"]
    assert said["differ"] == 1
    assert str(said["first_difference"]).startswith("cycle 40: state and reason are (")


def test_a_recording_of_before_reason_and_faults_were_kept_is_replayed(tmp_path: Path) -> None:
    """State and reason are not compared, for what the driver said is not known."""
    record(tmp_path / "rec", pulled)
    aged(tmp_path / "rec")
    said = replay(tmp_path / "rec", tmp_path / "out")["recorded_run"]
    assert (said["differ"], said["judged"], said["published_with"]) == (0, 0, None)
    assert said["cycles"] > 80  # type: ignore[operator]  # plain data


async def lost(bench: Bench) -> None:
    """Pushed on in a pause, without a word from its wheels."""
    await bench.drive(3.0)
    bench.daemon.cycle.inbox.put_command(Command(bench.loop.time(), Order.PAUSE))
    await asyncio.sleep(25.0)
    bench.daemon.cycle.inbox.put_command(Command(bench.loop.time(), Order.RESUME))
    await bench.drive(3.0)


def test_a_pose_that_is_a_guess_is_no_line_that_others_read(tmp_path: Path) -> None:
    """It stays in the file, in its place, as a remark that names the state."""
    bench = record(tmp_path / "rec", lost)
    replay(tmp_path / "rec", tmp_path / "out")
    state = {1.7e9 + snapshot.t_mono: snapshot.state for snapshot in bench.snapshots if snapshot.pose}
    guesses = (State.LOST, State.RELOCATING, State.AMBIGUOUS)
    stamps, _ = read_tum(tmp_path / "out" / "online.tum")
    lines = (tmp_path / "out" / "online.tum").read_text().splitlines()[1:]
    remarks = [line.split() for line in lines if line.startswith("# ")]
    assert len(remarks) > 10
    assert len(stamps) + len(remarks) == len(lines) == len(read_tum(tmp_path / "out" / "trajectory.tum")[0])
    assert all(state[min(state, key=lambda t: abs(t - stamp))] not in guesses for stamp in stamps.tolist())
    for _, name, stamp, *pose in remarks:
        assert state[min(state, key=lambda t: abs(t - float(stamp)))].name == name
        assert len(pose) == 7
    assert {name for _, name, *_ in remarks} <= {state.name for state in guesses}


def test_a_recording_that_lost_its_end_is_replayed_up_to_there(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", calm)
    (segment,) = (tmp_path / "rec").rglob("*.lumirec")
    data = segment.read_bytes()
    segment.write_bytes(data[: len(data) * 2 // 3])
    summary = replay(tmp_path / "rec", tmp_path / "out")
    assert summary["recorded_run"]["differ"] == 0
    assert 40 < summary["recorded_run"]["cycles"] < bench.daemon.cycle.cycles - 10  # type: ignore[operator]  # plain data


def test_a_recording_with_a_hole_says_where_it_is_not_the_same_run_any_more(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "rec", calm)
    (segment,) = (tmp_path / "rec").rglob("*.lumirec")
    data = bytearray(segment.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 200] = bytes(200)
    segment.write_bytes(data)
    summary = replay(tmp_path / "rec", tmp_path / "out")
    assert summary["recorded_run"]["differ"] > 0  # type: ignore[operator]  # plain data
    said = capsys.readouterr().err
    assert "is damaged" in said
    assert "cycles differ from the recorded run; cycle" in said


def test_a_person_may_replay_with_another_configuration(tmp_path: Path) -> None:
    record(tmp_path / "rec", calm)
    arguments = ["--out", str(tmp_path / "out"), "--set", "lidar.mount.yaw=29"]
    assert parser.main(["replay", str(tmp_path / "rec"), *arguments]) == console.OK
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["config"]["lidar"]["mount"] == {"x": 0.1, "y": -0.02, "yaw": 29.0, "inverted": False}
    assert summary["config"]["lidar"]["device"] == USB  # what nobody asked for is as recorded
    assert summary["recorded_run"]["differ"] > 0
    assert summary["log"]["recorded_versions"]["numpy"]
