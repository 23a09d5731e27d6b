"""Command: a simulated HOKUYO as a device of this computer, to try the daemon without a sensor.

python -m hal.fake --model UTM-30LX --pty /tmp/lidar
python -m hal.fake --model UST-10LX --tcp 127.0.0.1:10940 --faults faults.toml --control /tmp/lidar.control
"""

from __future__ import annotations

import argparse
import asyncio
import math
import sys
from dataclasses import dataclass
from pathlib import Path

from hal.errors import HalError
from hal.fake.faults.control import Control, serve_control
from hal.fake.faults.orders import FaultError
from hal.fake.faults.schedule import FaultSchedule
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import MODELS, LidarModel, Unit
from hal.fake.lidar.scan import ScanSource
from hal.fake.lidar.scan_world import RecordedRanges, Room
from hal.fake.transport.pty_server import PtyServer
from hal.fake.transport.tcp_server import TcpServer
from hal.run_server import print_line, until_stopped


@dataclass(slots=True)
class _Options:
    model: str
    world: str
    pty: Path | None
    tcp: str | None
    faults: Path | None
    control: Path | None
    serial: str
    clock_ms: int
    clock_ppm: float
    cold: bool
    seconds: float
    seed: int


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m hal.fake", description="A simulated HOKUYO lidar.")
    add = parser.add_argument
    add("--model", default="UTM-30LX", choices=sorted(MODELS), help="type of sensor (default %(default)s)")
    add(
        "--world",
        default="box",
        help="box (moving in a small room), still (at rest in it), or an .npz file with an array range_mm",
    )
    add("--pty", type=Path, metavar="LINK", help="serve as a serial port, found by this symbolic link")
    add("--tcp", metavar="HOST:PORT", help="serve over TCP, port 0 chooses a free one")
    add("--faults", type=Path, metavar="FILE", help="TOML schedule of faults, starts at once")
    add("--control", type=Path, metavar="SOCKET", help="accept fault commands on a unix socket")
    add("--serial", default="H0000001", help="serial number of the sensor (default %(default)s)")
    add("--clock-ms", type=int, default=0, help="initial value of the sensor's 24-bit clock")
    add("--clock-ppm", type=float, default=0.0, help="rate error of the sensor's clock, in ppm")
    add("--cold", action="store_true", help="begin with the start-up of the sensor")
    add("--seconds", type=float, default=0.0, help="end after this time (default: run until interrupted)")
    add("--seed", type=int, default=0, help="seed of noise, jitter and random faults")
    return parser


def _world(options: _Options, model: LidarModel) -> ScanSource:
    if options.world == "box":
        return Room(model, seed=options.seed)
    if options.world == "still":
        return Room(model, seed=options.seed, lap_s=math.inf)
    return RecordedRanges(Path(options.world), model)


async def _serve(options: _Options) -> None:
    model = MODELS[options.model]
    unit = Unit(
        serial=options.serial,
        clock_ms=options.clock_ms,
        clock_gain=options.clock_ppm * 1e-6,
        booted=not options.cold,
        seed=options.seed,
    )
    device = FakeHokuyo(model, _world(options, model), unit=unit)
    schedule = FaultSchedule({"lidar": device})
    if options.faults is not None:
        faults = schedule.load(options.faults.read_text(encoding="utf-8"))
        print_line(f"{len(faults)} faults of {options.faults} scheduled")
    pty = tcp = control = None
    try:
        if options.tcp is not None:
            host, _, port = options.tcp.rpartition(":")
            tcp = TcpServer(device)
            print_line(f"{options.model} on tcp://{host}:{await tcp.listen(host, int(port))}")
        if options.pty is not None or options.tcp is None:
            pty = PtyServer(device, options.pty)
            print_line(f"{options.model} on {pty.path}")
        if options.control is not None:
            control = await serve_control(Control(schedule), options.control)
            print_line(f"fault commands on {options.control}")
        await until_stopped(options.seconds)
    finally:
        schedule.close()
        if pty is not None:
            pty.close()
        if tcp is not None:
            await tcp.close()
        if control is not None:
            control.close()
        device.close()
    counts = device.counts
    print_line(
        f"{device.scans_sent} scans made; replies: {counts.sent} sent, {counts.without_host} without a host, "
        f"{counts.lost_in_sensor} lost in the sensor, {counts.refused_by_host} lost at a full queue"
    )


def _is_address(text: str) -> bool:
    host, _, port = text.rpartition(":")
    return host != "" and port.isascii() and port.isdigit() and int(port) < 1 << 16


def main(arguments: list[str] | None = None) -> int:
    """Run until interrupted; 2 when something in the arguments is wrong."""
    options = _Options(**vars(_parser().parse_args(arguments)))
    if options.pty is not None and options.tcp is not None:
        sys.stderr.write("a sensor has one line; give --pty or --tcp\n")
        return 2
    if options.tcp is not None and not _is_address(options.tcp):
        sys.stderr.write(f"--tcp {options.tcp}: expected HOST:PORT, as 127.0.0.1:10940\n")
        return 2
    try:
        asyncio.run(_serve(options))
    except (HalError, FaultError, OSError, UnicodeDecodeError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
