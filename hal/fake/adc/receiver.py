"""Command: a simulated light receiver on a bus of its own, to try the daemon without hardware.

::

    python -m hal.fake.adc.receiver unix:/tmp/i2c
    python -m hal.fake.adc.receiver tcp://127.0.0.1:10941 --chip ADC121C021 --address 0x54 --faults faults.toml

The daemon's bus is then ``unix:/tmp/i2c`` or ``tcp://127.0.0.1:10941``.
"""

from __future__ import annotations

import argparse
import asyncio
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hal.bus.i2c_server import BusServer
from hal.clock import SystemClock
from hal.errors import HalError
from hal.fake.adc.chips import SampleSource
from hal.fake.adc.converter import FakeAdc, FakeBuses
from hal.fake.adc.i2c_adapters import ADAPTERS
from hal.fake.adc.light import OrdinaryLamps, RecordedLight
from hal.fake.faults.control import Control, serve_control
from hal.fake.faults.orders import FaultError
from hal.fake.faults.schedule import FaultSchedule
from hal.run_server import print_line, until_stopped

BUS = "simulated"
DC_ADDRESS = 0x48
DC_REST = 0.1 / 3.3
"""Output of the amplifier without light, as a fraction of the supply."""


@dataclass(slots=True)
class _Options:
    where: str
    chip: str
    address: int
    adapter: str
    light: Path | None
    dc: float | None
    scl_percent: float
    faults: Path | None
    control: Path | None
    seconds: float
    seed: int
    anyone: bool


def _number(text: str) -> int:
    return int(text, 0)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m hal.fake.adc.receiver", description="A simulated light receiver.")
    add = parser.add_argument
    add("where", help="serve the bus at unix:/path or tcp://host:port")
    add("--chip", default="MCP3221", choices=["MCP3221", "ADC121C021"], help="converter (default %(default)s)")
    add("--address", type=_number, default=0x4D, help="of the converter (default 0x4d)")
    add("--adapter", default="designware", choices=sorted(ADAPTERS), help="how the bus is driven (default %(default)s)")
    add("--light", type=Path, metavar="FILE", help=".npz with fraction and rate_hz (default: lamps without codes)")
    add(
        "--dc",
        type=float,
        metavar="LEVEL",
        help="add an ADS1115 at 0x48: 0 is dark, 1 saturated",
    )
    add("--scl-percent", type=float, default=0.0, help="deviation of SCL from its nominal rate")
    add("--faults", type=Path, metavar="FILE", help="TOML schedule of faults, starts at once")
    add("--control", type=Path, metavar="SOCKET", help="accept fault commands on a unix socket")
    add("--seconds", type=float, default=0.0, help="end after this time (default: run until interrupted)")
    add("--anyone", action="store_true", help="serve TCP beyond this computer")
    add("--seed", type=int, default=0, help="seed of noise, jitter and random faults")
    return parser


def _device(options: _Options) -> FakeAdc:
    source: SampleSource = OrdinaryLamps(seed=options.seed)
    if options.light is not None:
        source = RecordedLight(options.light)
    device = FakeAdc(
        source,
        SystemClock(),
        chip=options.chip,
        address=options.address,
        adapter=ADAPTERS[options.adapter],
        seed=options.seed,
    )
    device.bus.scl_error = 0.01 * options.scl_percent
    level = options.dc
    if level is not None:
        device.add_level(lambda t: np.full_like(t, DC_REST + level * (1.0 - DC_REST)), DC_ADDRESS)
    return device


async def _serve(options: _Options) -> None:
    device = _device(options)
    buses = FakeBuses(SystemClock())
    buses.plug(BUS, device)
    server = BusServer(buses, BUS, SystemClock(), anyone=options.anyone)
    schedule = FaultSchedule({"adc": device})
    control = None
    try:
        if options.faults is not None:
            faults = schedule.load(options.faults.read_text(encoding="utf-8"))
            print_line(f"{len(faults)} faults of {options.faults} scheduled")
        print_line(f"{options.chip} at {options.address:#04x} on {await server.listen(options.where)}")
        if options.control is not None:
            control = await serve_control(Control(schedule), options.control)
            print_line(f"fault commands on {options.control}")
        await until_stopped(options.seconds)
    finally:
        schedule.close()
        if control is not None:
            control.close()
        await server.close()
    print_line(f"{device.bus.transactions} transactions")


def main(arguments: list[str] | None = None) -> int:
    """Run until interrupted; 2 when something in the arguments is wrong."""
    options = _Options(**vars(_parser().parse_args(arguments)))
    try:
        asyncio.run(_serve(options))
    except (HalError, FaultError, OSError, UnicodeDecodeError) as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
