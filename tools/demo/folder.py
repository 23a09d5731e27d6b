"""The folder that a demo leaves: map, recording and configuration, with the commands to go on."""

import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
CONFIG: Final = "demo.toml"
RECORDING: Final = "recording"
SURVEY: Final = "lamps.toml"
MAPS: Final = "maps"
MAP: Final = "map.lumimap"
PICTURE: Final = "map.png"
NOTE: Final = "README.txt"
KEPT: Final = (PICTURE, MAP, RECORDING, CONFIG, "summary.json", NOTE)
"""What a person may go on with."""
ODOMETRY_PORT: Final = 5601
MODBUS_PORT: Final = 1502
LIDAR_X: Final = 0.15
"""Position of the lidar on the simulated robot (:class:`tools.sim.robot.drive.Body`), configured as `lidar.mount`."""
MARGIN_M: Final = 2.5
"""The picture shows this much around the path: behind the panes of glass there is much to see, and nothing to drive."""


@dataclass(frozen=True, slots=True)
class Wiring:
    """Where the daemon finds the simulated robot. ``bus``: of the photodiode; empty: there is none."""

    name: str
    lidar: Path
    odometry: int
    modbus: int
    bus: str
    maps: str = "none"

    def config(self) -> str:
        """The daemon's configuration."""
        text = (
            f'name = "{self.name}"\nbind = "127.0.0.1"\n\n'
            f'[lidar]\ndevice = "{self.lidar}"\n\n[lidar.mount]\nx = {LIDAR_X}\n\n'
            f'[map]\nfolder = "{self.maps}"\n\n[odometry]\nport = {self.odometry}\n\n'
            f"[modbus]\nport = {self.modbus}\nwrite = true\n"
        )
        return text + (f'\n[photodiode]\nbus = "{self.bus}"\n\n[lights]\nsurvey = "{SURVEY}"\n' if self.bus else "")


def clear(out: Path) -> None:
    """Remove what an earlier demo has left there, and nothing else."""
    for name in (RECORDING, MAPS, "replay"):
        shutil.rmtree(out / name, ignore_errors=True)
    for name in (CONFIG, SURVEY, MAP, PICTURE, NOTE, "summary.json"):
        (out / name).unlink(missing_ok=True)


def keep(folder: Path, out: Path, building: str) -> str:
    """Move what the demo made in ``folder`` to ``out``, and make map and picture of its recording.

    Returns what went wrong, if anything.
    """
    lit = (folder / SURVEY).exists()
    for name in (RECORDING, SURVEY):
        if (folder / name).exists():
            shutil.move(folder / name, out / name)
    bus = f"unix:{out / 'i2c'}" if lit else ""
    wiring = Wiring("demo", out / "lidar", ODOMETRY_PORT, MODBUS_PORT, bus, MAPS)
    (out / CONFIG).write_text(wiring.config())
    (out / NOTE).write_text(note(out, building, lit))
    if not (out / RECORDING).exists():
        return "no recording was made"
    if wrong := _replay(out):
        return f"the recording could not be replayed: {wrong}"
    shutil.copyfile(out / "replay" / PICTURE, out / PICTURE)
    if (made := out / "replay" / MAP).exists():
        shutil.copyfile(made, out / MAP)
        (out / MAPS).mkdir(exist_ok=True)
        shutil.copyfile(made, out / MAPS / MAP)
    return ""


def _replay(out: Path) -> str:
    command = [sys.executable, "-m", "daemon", "replay", str(out / RECORDING), "--out", str(out / "replay")]
    command += ["--margin", f"{MARGIN_M:g}", "--config", str(out / CONFIG)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr.strip() or f"exit code {done.returncode}"


def note(out: Path, building: str, lit: bool) -> str:
    """What lies in the folder and what can be done with it."""
    sim = f"python -m tools.sim --building {building} --pty {out / 'lidar'} --odometry udp://127.0.0.1:{ODOMETRY_PORT}"
    if lit:
        sim += f" --light unix:{out / 'i2c'} --survey {out / SURVEY}"
    return f"""{PICTURE}       image of the map, with the path of the robot
{MAP}   the map; {MAPS}/ holds it for the next start
{RECORDING}/    recording of all sensor data
{CONFIG}     the configuration of the daemon
summary.json  the figures of this demo

Inspect the map, or replay the drive (from the root of the clone, after `. .venv/bin/activate`):

    lumiloop map info {out / MAP}
    lumiloop replay {out / RECORDING} --config {out / CONFIG} --out {out / "again"}

Continue with this map: the robot in one terminal, the daemon in another, the page in a third.

    {sim}
    lumiloop run --config {out / CONFIG}
    lumiloop view --config {out / CONFIG} --write
"""
