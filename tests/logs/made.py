"""Recordings of the simulator that are committed: what `lumiloop run --record` writes, kept as one packed file each.

``python -m tests.logs.made NAME``: make one anew. The bytes are the lidar's, the converter's and the wheels' own; a
recording stays as it is when the simulator changes, so that a pose that moves has been moved by the daemon.
"""

import asyncio
import io
import lzma
import math
import sys
import tarfile
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.app import Daemon
from daemon.config.endpoints import NO_DEVICE
from daemon.config.schema import Config, LidarConfig, ModbusConfig, Mount, OdometryConfig, PhotodiodeConfig
from daemon.devices.light_setup import Lights
from daemon.recording.recorder import Recorder
from estimator.cdma.air_interface import PROFILE_A
from hal.clock import LoopClock, run_virtual
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import Unit
from hal.fake.transport.memory_host import FakeOpener
from hal.net.inputs import InputPort
from tests.daemon.support.light_room import SURVEY, Lit, plugged
from tools.bench.world.room import LIDAR, room
from tools.sim.feed import feed_odometry
from tools.sim.harness import DEVICE, world
from tools.sim.scene import Scenario, SimulatedScene

FOLDER: Final = Path(__file__).parent / "recordings"
BUS: Final = "/dev/i2c-7"


@dataclass(frozen=True)
class Making:
    """What is recorded: seconds; with lamps over a robot that stands, or a drive with laser and wheels."""

    seconds: float
    lamps: bool = False


MADE: Final = {"laps": Making(75.0), "lamps": Making(4.0, lamps=True)}


def packed(name: str) -> Path:
    """The committed file."""
    return FOLDER / f"{name}.tar.xz"


def unpacked(name: str, folder: Path) -> Path:
    """The recording as replay reads it, below ``folder``."""
    with tarfile.open(packed(name), "r:xz") as archive:
        if sys.version_info >= (3, 11, 4):  # there are no filters before; what is committed here is our own
            archive.extractall(folder, filter="data")
        else:
            archive.extractall(folder)
    (found,) = folder.glob("recording*")
    return found


def make(name: str) -> int:
    """Record anew and pack; returns the bytes."""
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made) / "recording"
        run_virtual(_recorded(MADE[name], folder), start=100.0)
        data = io.BytesIO()
        with tarfile.open(fileobj=data, mode="w") as archive:
            for path in sorted(folder.rglob("*")):
                archive.add(path, f"recording/{path.relative_to(folder)}", recursive=False, filter=_nobody)
        FOLDER.mkdir(exist_ok=True)
        packed(name).write_bytes(lzma.compress(data.getvalue(), preset=9 | lzma.PRESET_EXTREME))
    return packed(name).stat().st_size


def _nobody(entry: tarfile.TarInfo) -> tarfile.TarInfo:
    entry.uid = entry.gid = entry.mtime = 0
    entry.uname = entry.gname = ""
    return entry


async def _recorded(making: Making, folder: Path) -> None:
    clock = LoopClock(asyncio.get_running_loop(), utc_at_zero=1.7e9)
    scene = SimulatedScene(Scenario(lidar=LIDAR, people=False), room())
    device = FakeHokuyo(scene.model, scene.scan, unit=Unit(seed=1))
    opener = FakeOpener(clock)
    opener.plug(DEVICE, device)
    around = world(clock, opener, lambda snapshot: None)
    if making.lamps:
        around.buses, _ = plugged(clock, Lit(), BUS)
        around.lights = Lights(SURVEY, PROFILE_A, 0.0)
    x, y, yaw = scene.mount
    settings = Config(
        lidar=LidarConfig(device=NO_DEVICE if making.lamps else DEVICE, mount=Mount(x, y, math.degrees(yaw))),
        odometry=OdometryConfig(port=0 if making.lamps else 1), modbus=ModbusConfig(port=0),
        photodiode=PhotodiodeConfig(bus=BUS if making.lamps else ""),
    )  # fmt: skip
    recorder = Recorder(folder, settings, clock, lights=around.lights)
    daemon = Daemon(settings, around, recorder)
    port = InputPort(clock, "", 1)
    for part in ("odometry", "imu"):
        daemon.network.parts.pop(part, None)
    port.send_odometry_to(recorder.on_odometry(daemon.cycle.inbox.put_odometry))
    rolling = asyncio.create_task(feed_odometry(scene, lambda data: port.receive(data, clock.now())))
    stop = asyncio.Event()
    asyncio.get_running_loop().call_later(making.seconds, stop.set)
    try:
        await daemon.run(stop)
    finally:
        rolling.cancel()
        device.close()


if __name__ == "__main__":
    for wanted in sys.argv[1:] or MADE:
        sys.stdout.write(f"{wanted}: {make(wanted)} bytes\n")
