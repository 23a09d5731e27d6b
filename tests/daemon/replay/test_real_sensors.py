"""Real ranges of real HOKUYO sensors through the fake sensor, the wire, the real driver and the whole daemon.

The same scans are replayed from the converted log, so that the two ways into the daemon are held against each other.
"""

import asyncio
import math
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from daemon.app import Daemon, Environment
from daemon.config.schema import Config, LidarConfig, Mask, ModbusConfig, Mount
from daemon.replay import convert
from daemon.replay.log_replay import replay
from daemon.replay.recorded_inputs import Given
from daemon.replay.sources import open_log
from daemon.runtime.budget import FixedBudget
from daemon.runtime.cycle_parts import CycleRecord
from daemon.runtime.worker import CycleWorker
from estimator.numerics import se2
from hal.clock import Clock, LoopClock, SystemClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import URG_04LX_UG01, UTM_30LX, LidarModel, Unit
from hal.fake.lidar.rotor import TimetableRotor
from hal.fake.lidar.scan import FakeScan
from hal.fake.transport.memory_host import FakeOpener
from hal.fake.transport.pty_server import PtyServer
from hal.lidar import VALID, RawScan
from hal.odometry import RawOdometry
from hal.port.opening import open_port
from hal.port.port import PortOpener

Array = npt.NDArray[np.float64]

USB = "/dev/ttyACM0"
WARM_TURNS = 60
"""Turns before the first recorded one, unseen by the daemon: the driver finds the sensor and learns its clock."""

ROVER = LidarConfig(mount=Mount(*convert.ROVER_MOUNT), mask=Mask(sectors=((95.1, 125.0), (-125.0, -95.1))))
NOMINAL_BEAM_DT_S = 0.1 / 1024.0


@dataclass
class Played:
    """What the daemon made of it: scans as the driver delivered them, T_odom_base after each, by scan number."""

    scans: list[RawScan]
    poses: dict[int, Array]


class Stage:
    """Recorded scans on a fake sensor, at turns of the motor that begin in the middle of a millisecond.

    SCIP stamps are whole milliseconds. From the middle, an error of up to half of one does not change which it is.
    """

    def __init__(self, scans: convert.Scans, model: LidarModel, t_first: float) -> None:
        period = scans.laser.period
        self.scans = scans
        self.cut = np.rint((scans.stamps - scans.stamps[0]) * 1e3) / 1e3 + t_first
        self.first_beams = self.cut + 0.5e-3
        warm = self.first_beams[0] - period * np.arange(WARM_TURNS, 0, -1)
        self._starts = np.concatenate([warm, self.first_beams]) - model.amin * period / model.ares
        self._rows = np.pad(scans.ranges, ((0, 0), (model.amin, 0))).astype(np.int32)
        model = replace(model, true_period_s=period)
        rotor = TimetableRotor(self._starts.tolist(), period)
        self.device = FakeHokuyo(model, self._source, unit=Unit(seed=1), rotor=rotor)

    def _source(self, t_mono: float) -> FakeScan:
        turn = int(np.abs(self._starts - t_mono).argmin())
        return FakeScan(self._rows[max(0, turn - WARM_TURNS)])

    def recorded(self, scan: RawScan) -> bool:
        """Whether this is no warm-up turn."""
        return bool(scan.t_mono > self.first_beams[0] - 0.5 * self.scans.laser.period)

    async def play(self, daemon: Daemon, cut: bool) -> Played:
        """Run the daemon until the last scan has been taken; ``cut``: it sees stamps of whole milliseconds only."""
        played = Played([], {})
        pass_on = daemon.pacemaker.on_scan

        def on_scan(scan: RawScan) -> None:
            if self.recorded(scan):
                played.scans.append(scan)
                pass_on(replace(scan, t_mono=math.floor(scan.t_mono * 1e3) / 1e3) if cut else scan)

        def keep(record: CycleRecord) -> None:
            if record.scan is not None and record.result is not None:
                played.poses[record.scan] = record.result.T_odom_base

        daemon._on_scan = on_scan
        daemon.cycle.parts.tap = keep
        stop = asyncio.Event()
        running = asyncio.create_task(daemon.run(stop))
        wheels = asyncio.create_task(self._drive(daemon))
        await asyncio.wait_for(wheels, None)
        await asyncio.sleep(1.0)
        stop.set()
        await asyncio.wait_for(running, 10.0)
        self.device.close()
        return played

    async def _drive(self, daemon: Daemon) -> None:
        """The wheels' pose at each scan, as the log has it."""
        loop = asyncio.get_running_loop()
        for t, (x, y, yaw) in zip(self.cut.tolist(), self.scans.poses.tolist(), strict=True):
            await asyncio.sleep(t - loop.time())
            daemon.cycle.inbox.put_odometry(RawOdometry(t, t, x, y, yaw))


def make_daemon(lidar: LidarConfig, device: str, clock: Clock, opener: PortOpener) -> Daemon:
    async def warm() -> None:
        from daemon.runtime.warmup import load

        load()

    settings = Config(lidar=msgspec.structs.replace(lidar, device=device), modbus=ModbusConfig(port=0))
    world = Environment(
        clock, opener=opener, make_worker=CycleWorker, make_budget=FixedBudget, stopwatch=None, warm_up=warm,
        draw_map_id=lambda: 1,
    )  # fmt: skip
    return Daemon(settings, world)


def through_memory(scans: convert.Scans, model: LidarModel, lidar: LidarConfig) -> Played:
    async def main() -> Played:
        clock = LoopClock(asyncio.get_running_loop())
        stage = Stage(scans, model, math.ceil((WARM_TURNS + 2) * scans.laser.period))
        opener = FakeOpener(clock)
        opener.plug(USB, stage.device)
        return await stage.play(make_daemon(lidar, USB, clock, opener), cut=True)

    return run_virtual(main())


def through_pty(scans: convert.Scans, model: LidarModel, lidar: LidarConfig, link: Path) -> Played:
    async def main() -> Played:
        now = asyncio.get_running_loop().time()
        stage = Stage(scans, model, math.ceil(now + (WARM_TURNS + 2) * scans.laser.period))
        port = PtyServer(stage.device, link)
        try:
            return await stage.play(make_daemon(lidar, str(link), SystemClock(), open_port), cut=False)
        finally:
            port.close()

    return asyncio.run(main())


def from_log(path: Path, scans: convert.Scans, lidar: LidarConfig) -> list[Array]:
    """T_odom_base of every scan, by replay of the converted log with its stamps cut to milliseconds."""
    convert.write(path, scans, "test")
    outcome = replay(open_log(path), Config(lidar=lidar), Given(file=True))
    return list(outcome.rerun.ledger.odom())


@pytest.fixture(scope="module")
def rover(log_root: Path) -> convert.Scans:
    """Every range of exp1 at the turns of the motor, one every 99 ms instead of 98.7; poses with a log's digits."""
    scans = convert.even_stamps(convert.read(log_root / "urg04lx" / "exp1.dat.gz"), convert.DELAY_S)
    turns = np.rint((scans.stamps - scans.stamps[0]) / scans.laser.period)
    laser = replace(scans.laser, period=0.099, beam_dt=NOMINAL_BEAM_DT_S)
    return replace(scans, laser=laser, stamps=turns * 99 / 1e3, poses=np.round(scans.poses, 9))


def bit_identical(played: Played, scans: convert.Scans, dmin: int, dmax: int) -> None:
    assert len(played.scans) == len(scans.ranges)
    for number, (scan, row) in enumerate(zip(played.scans, scans.ranges, strict=True)):
        valid = (row >= dmin) & (row <= dmax)
        assert np.array_equal(scan.ranges, np.where(valid, row, 0)), number
        assert np.array_equal(scan.code, np.where(valid, VALID, row)), number


def largest_difference(played: Played, log: list[Array]) -> tuple[float, float]:
    """Metres and radians between the two ways, over all scans."""
    assert len(played.poses) == len(log)
    off = np.array([played.poses[scan.seq] for scan in played.scans]) - np.array(log)
    turn = np.abs(np.remainder(off[:, 2] + math.pi, 2 * math.pi) - math.pi)
    return float(np.hypot(off[:, 0], off[:, 1]).max()), float(turn.max())


@pytest.mark.system
def test_urg_over_a_memory_port(rover: convert.Scans, tmp_path: Path) -> None:
    played = through_memory(rover, URG_04LX_UG01, ROVER)
    bit_identical(played, rover, 20, 5600)
    off_m, off_rad = largest_difference(played, from_log(tmp_path / "a.log", rover, ROVER))
    assert off_m < 0.001
    assert off_rad < 0.001


@pytest.fixture(scope="module")
def over_pty(rover: convert.Scans, tmp_path_factory: pytest.TempPathFactory) -> Played:
    """75 s in real time, once for all that is judged from it."""
    return through_pty(rover, URG_04LX_UG01, ROVER, tmp_path_factory.mktemp("pty") / "lidar")


@pytest.fixture(scope="module")
def of_log(rover: convert.Scans, tmp_path_factory: pytest.TempPathFactory) -> list[Array]:
    """The replay that the recording over the pty is held against."""
    return from_log(tmp_path_factory.mktemp("log") / "a.log", rover, ROVER)


@pytest.mark.realtime
@pytest.mark.slow
def test_urg_over_a_real_pty_bit_by_bit_and_to_the_millisecond(rover: convert.Scans, over_pty: Played) -> None:
    bit_identical(over_pty, rover, 20, 5600)
    times = np.array([scan.t_mono for scan in over_pty.scans])
    off = times - times.mean() - (rover.stamps - rover.stamps.mean())
    assert np.abs(off).max() < 4 * 0.5e-3


@pytest.mark.realtime
@pytest.mark.slow
@pytest.mark.xfail(
    reason="scan matching turns a micrometre of odometry noise into decimetres on this log", strict=False
)
def test_urg_over_a_real_pty_gives_the_trajectory_of_the_log(over_pty: Played, of_log: list[Array]) -> None:
    off_m, off_rad = largest_difference(over_pty, of_log)
    assert off_m < 0.02
    assert off_rad < 0.02


@pytest.mark.realtime
@pytest.mark.slow
def test_urg_over_a_real_pty_gives_the_motions_of_the_log(over_pty: Played, of_log: list[Array]) -> None:
    """Scan for scan the motion of the replay; over the whole drive what such a sensor's drift leaves open.

    Half a millisecond of jitter is a third of a millimetre of motion. Of a sensor of 4 m and 1 cm, 46 m without closed
    loops, even a micrometre makes another map of the same quality: ends lie decimetres apart.
    """
    log = np.array(of_log)
    live = np.array([over_pty.poses[scan.seq] for scan in over_pty.scans])
    assert len(live) == len(log)
    off = np.array([se2.between(*pair)[:2] for pair in zip(moves(live), moves(log), strict=True)])
    assert np.median(np.hypot(*off.T)) < 0.01
    way = np.hypot(*np.diff(log[:, :2], axis=0).T).sum()
    assert np.hypot(*(live - log)[:, :2].T).max() < 0.03 * way


def moves(poses: Array) -> list[Array]:
    """Motion from each pose to the next."""
    return [se2.between(a, b) for a, b in pairwise(poses)]


@pytest.mark.realtime
@pytest.mark.slow
def test_utm_in_real_time_over_a_pty_none_missed(log_root: Path, tmp_path: Path) -> None:
    scans = convert.read(log_root / "utm30lx" / "scans.npz")
    scans = replace(scans, laser=replace(scans.laser, period=float(np.median(np.diff(scans.stamps)))))
    played = through_pty(scans, UTM_30LX, LidarConfig(), tmp_path / "lidar")
    bit_identical(played, scans, 23, 60_000)
    assert len(played.poses) == len(scans.ranges) == 885  # every one went through a cycle of its own
    seqs = [scan.seq for scan in played.scans]
    assert seqs == list(range(seqs[0], seqs[0] + 885))
