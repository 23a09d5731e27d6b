"""What the robot computer under test needs of a scenario: a configuration, and the survey of the lamps overhead."""

import socket
from pathlib import Path
from typing import Final

from tools.bench.world.scenario import Scenario
from tools.bench.world.stage import CannotPlay, Ends, is_port
from tools.sim.light.serve import write_plan

CONFIG: Final = "lumiloop.toml"
SURVEY: Final = "lamps.toml"
ANYWHERE: Final = ("0.0.0.0", "[::]")


def write_config(folder: Path, scenario: Scenario, ends: Ends) -> list[Path]:
    """Write both into a folder, which is made; the files, of which there is no survey where no lamps are.

    Raises:
        CannotPlay: there is a file already that is not overwritten, the robot computer cannot be reached from here, or
            a scenario with lamps is to send its light nowhere, or an address is none.
    """
    scene = scenario.scene(held=True)
    if scene.light is not None and not ends.light:
        raise CannotPlay("the scenario has coded lamps: say with --light where their light goes")
    files = [folder / CONFIG, *([folder / SURVEY] if scene.light is not None else [])]
    if there := [file for file in files if file.exists()]:
        raise CannotPlay(f"{there[0]} is there already: name another folder with --write-config")
    text = _text(scenario, ends, own_address(*ends.modbus))
    folder.mkdir(parents=True, exist_ok=True)
    if scene.light is not None:  # first: it may fail, and another attempt must not meet a configuration
        write_plan(scene.light, folder / SURVEY)
    files[0].write_text(text, encoding="utf-8")
    return files


def own_address(host: str, port: int) -> str:
    """By which address of this computer the other one is reached; nothing is sent to it."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as way:
            way.connect(address)
            return str(way.getsockname()[0])
    except OSError as error:
        raise CannotPlay(f"--modbus {host}: {error.strerror}: the robot computer cannot be reached") from error


def _text(scenario: Scenario, ends: Ends, bench: str) -> str:
    """The configuration file."""
    x, y, _ = scenario.scene(held=True).mount
    robot, port = ends.modbus
    lines = [
        f"# For {robot}, while a bench computer plays the scenario {scenario.name} to it (docs/bench.md).",
        'bind = "0.0.0.0"',
        f'allow = ["{bench}"]',
        "",
        "[lidar]",
        *_device(ends.lidar, bench),
        f"mount = {{ x = {x:g}, y = {y:g} }}",
        "",
        "[modbus]",
        f"port = {port}",
        "",
        "[map]",
        'folder = "none"  # a map of another drive, or of the real building, would be looked through for this place',
    ]
    if ends.odometry and scenario.world.odometry:
        lines += ["", "[odometry]", f"port = {_port(ends.odometry, 'udp://')}"]
    if scenario.world.lamps:
        bus = "/dev/i2c-1" if ends.light.startswith("dac:") else _reached(ends.light, bench)
        lines += ["", "[photodiode]", f'bus = "{bus}"', 'converter = "mcp3221@0x4d"']
        lines += ["", "[lights]", f'survey = "{SURVEY}"']
    return "\n".join(lines) + "\n"


def _device(lidar: str, bench: str) -> list[str]:
    if lidar.startswith("tcp://"):
        return [f'device = "{_reached(lidar, bench)}"']
    usb = lidar.startswith("/dev/ttyGS")
    device = "/dev/ttyACM0" if usb else lidar.removeprefix("pty:") if lidar.startswith("pty:") else "/dev/ttyUSB0"
    rate = "" if usb or lidar.startswith("pty:") else f"@{lidar.partition('@')[2] or '115200'}"
    return [f'device = "{device}{rate}"  # as the line from the bench is called there']


def _reached(served: str, bench: str) -> str:
    """A name that is served by this computer, as the other one says it."""
    if not served.startswith("tcp://"):
        return served
    port = _port(served, "tcp://")
    return f"tcp://{bench}:{port}" if served.removeprefix("tcp://").rpartition(":")[0] in ANYWHERE else served


def _port(address: str, scheme: str) -> str:
    host, _, port = address.removeprefix(scheme).rpartition(":")
    if not (address.startswith(scheme) and host and is_port(port)):
        raise CannotPlay(f"{address}: expected {scheme}HOST:PORT")
    return port
