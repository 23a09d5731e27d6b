"""The doctor, on a computer on which one thing after the other is broken."""

import argparse
import errno
import json
import os
import re
import socket
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from daemon.cli.doctor import examine
from daemon.config.schema import PhotodiodeConfig
from daemon.diagnosis.host import Heard, Host, Mute
from daemon.maps.store import Store
from daemon.publish.stream.messages import Fault, Faults, Pose
from daemon.runtime.warmup import CannotLoad, Warmth
from daemon.system import console
from hal.errors import DeviceFault
from hal.hokuyo.probe import Finding
from hal.lidar import LidarGeometry
from hal.photodiode.probe import BusFinding, Chip
from tests.taps.serving import served

ROOT = Path(__file__).parents[3]
GEOMETRY = LidarGeometry("UTM-30LX", "H0906091", "f", 1440.0, 540.0, 0, 1080, 23, 60000, 0.001, 0.025, 0.0)
BUS = "/dev/i2c-1"
CONFIG = f'lidar.device = "auto"\nodometry.port = 7000\nphotodiode.bus = "{BUS}"\nlights.survey = "lights.toml"\n'
POSE = Pose(seq=1, t_mono=1.0, t_sent=1.0, t_utc=1.7e9, state=3, state_name="TRACKING", reason=0, pose=(0.0, 0.0, 0.0))


@dataclass
class Computer(Host):
    """One on which all is well, until something is changed."""

    heard: Heard | Mute | str = "no daemon listens there"
    ttys: list[str] = field(default_factory=lambda: ["/dev/ttyACM0"])
    missing: set[str] = field(default_factory=set)
    closed: set[str] = field(default_factory=set)
    bus: BusFinding = field(default_factory=lambda: BusFinding(BUS, "i2c", (Chip(0x4D, "MCP3221", True),)))
    lidar: Finding = field(default_factory=lambda: Finding("/dev/ttyACM0", GEOMETRY, "p", "SCIP 2.0"))
    t_utc: float = 1.76e9
    follows: bool | None = True
    room: int = 10 << 30
    ports: dict[int, int] = field(default_factory=dict)
    warmth: Warmth | None = field(default_factory=lambda: Warmth(False, 0.8))
    no_cache: str = ""
    warmed_for: PhotodiodeConfig | None = None
    rights: bool = True

    def utc(self) -> float:
        return self.t_utc

    def synchronised(self) -> bool | None:
        return self.follows

    def user(self) -> str:
        return "anna"

    def exists(self, path: str) -> bool:
        return path not in self.missing

    def usable(self, path: str) -> bool:
        return path not in self.closed

    def lidars(self) -> list[str]:
        return self.ttys

    def lidar_at(self, device: str) -> Finding:
        return self.lidar

    def chips_on(self, bus: str) -> BusFinding:
        return self.bus

    def free_bytes(self, folder: Path) -> int:
        return self.room

    def taken(self, kind: socket.SocketKind, host: str, port: int) -> OSError | None:
        return OSError(self.ports[port], os.strerror(self.ports[port])) if port in self.ports else None

    def resolved(self, host: str) -> str:
        return "Name or service not known" if host == "nohost" else ""

    def warm(self, photodiode: PhotodiodeConfig) -> Warmth | None:
        self.warmed_for = photodiode
        if self.no_cache:
            raise CannotLoad(self.no_cache)
        return self.warmth

    def realtime(self) -> bool:
        return self.rights

    def listen(self, path: Path) -> Heard | Mute | str:
        return self.heard


@pytest.fixture
def file(tmp_path: Path) -> Path:
    """A configuration with everything in it."""
    (tmp_path / "lights.toml").write_text((ROOT / "systemd/lights/room-of-16.toml").read_text())
    (tmp_path / "lumiloop.toml").write_text(CONFIG)
    return tmp_path / "lumiloop.toml"


def asked(file: Path | None, host: Host, *words: str, as_json: bool = False) -> int:
    return examine(argparse.Namespace(config=file, set=list(words), stream=None, json=as_json), host)


def test_where_all_is_well_nothing_has_to_be_fixed(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    computer = Computer()
    assert asked(file, computer) == console.OK
    said = capsys.readouterr().out
    assert computer.warmed_for == PhotodiodeConfig(bus=BUS)
    assert said.endswith("no problem was found\n")
    assert "FIX" not in said
    assert re.search(r"good +lidar +/dev/ttyACM0: UTM-30LX", said)
    assert re.search(r"good +survey .* 16 lamps", said)


def test_a_survey_that_is_not_there_is_named_with_its_line(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (file.parent / "lights.toml").unlink()
    assert asked(file, Computer()) == console.FAILED
    said = capsys.readouterr().out
    assert f"no such survey; `lumiloop survey` makes one from a drive ({file}:4 names it with `lights.survey`)" in said
    assert "-> create the file, or name another; then run `lumiloop check`" in said


def test_a_survey_by_a_name_that_no_file_can_have_is_told_as_any_other(
    file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file.write_text(CONFIG.replace("lights.toml", "x" * 300))
    assert asked(file, Computer()) == console.FAILED
    assert re.search(r"FIX +survey", capsys.readouterr().out)


def broken(**changes: object) -> Callable[[], Computer]:
    return lambda: Computer(**changes)  # type: ignore[arg-type]  # fields by name


TORN = BusFinding(BUS, error=DeviceFault(BUS, "SDA is held low", "switch the converter off and on"))
WRONG = BusFinding(BUS, "i2c", (Chip(0x4D, "ADC121C021", True),))
EMPTY = BusFinding(BUS, "i2c", (Chip(0x48, "ADS1015 or ADS1115"),))
AWRY = Faults(present=tuple(Fault(fault=number, meaning="a lamp", remedy="look") for number in (174, 175)))
ODD = Heard("agv", 7, POSE, AWRY, lamps={(5, 3): 1, (9, None): 7, (6, 4): 8, (7, 5): 3, (8, 6): 6})
FAULTY = Heard("agv", 7, POSE, Faults(present=(Fault(fault=104, meaning="no valid scan", remedy="check the cable"),)))

CASES = {
    "no lidar": (broken(ttys=[]), "lidar", "no serial device", "connect it and switch it on"),
    "no right to it": (
        broken(closed={"/dev/ttyACM0"}),
        "lidar",
        "access denied for anna",
        "usermod -aG dialout anna",
    ),
    "no answer": (
        broken(lidar=Finding("/dev/ttyACM0", error=DeviceFault("/dev/ttyACM0", "does not answer", "power it"))),
        *("lidar", "does not answer", "power it"),
    ),
    "no bus": (broken(missing={BUS}), "photodiode", "no such device", "enable the bus"),
    "no right to the bus": (broken(closed={BUS}), "photodiode", "access denied for", "usermod -aG i2c anna"),
    "bus stuck": (broken(bus=TORN), "photodiode", "SDA is held low", "off and on"),
    "other converter": (
        broken(bus=WRONG),
        "photodiode",
        "ADC121C021, but mcp3221 is configured",
        "correct `photodiode.converter`",
    ),
    "no converter": (broken(bus=EMPTY), "photodiode", "no mcp3221 at 0x4d; found: 0x48", "check power, SDA and SCL"),
    "no time": (broken(t_utc=12.0), "clock", "before 2025", "timedatectl set-ntp true"),
    "disk full": (broken(room=5 << 20), "disk", "5 MB are free", "free disk space there, or set"),
    "port taken": (broken(ports={1502: errno.EADDRINUSE}), "ports", "TCP 127.0.0.1:1502", "`ss -lnp` shows which"),
    "no such address": (
        broken(ports={1502: errno.EADDRNOTAVAIL}),
        *("ports", "does not have that address", "set bind to an address of this computer"),
    ),
    "no right to the port": (broken(ports={1502: errno.EACCES}), "ports", "Permission denied", "log"),
    "odometry port taken": (
        broken(ports={7000: errno.EADDRINUSE}),
        "ports",
        "UDP 127.0.0.1:7000",
        "odometry.port",
    ),
    "no cache": (
        broken(no_cache="no writable directory"),
        "kernels",
        "no writable directory",
        "a folder with write access",
    ),
    "kernels not stored": (
        broken(warmth=Warmth(True, 60.0, damaged=1, unwritten="/c/k: Read-only file system")),
        *("kernels", "/c/k: Read-only file system); each start compiles them", "NUMBA_CACHE_DIR"),
    ),
    "a fault of the daemon": (broken(heard=FAULTY), "daemon", "fault 104: no valid scan", "check the cable"),
    "not heard": (broken(heard=Mute("has no access", "usermod")), "daemon", "has no access", "usermod"),
    "no pose": (broken(heard=Heard("agv", 7)), "daemon", "runs, but publishes no pose", "read its log"),
    "no lamps": (broken(heard=Heard("agv", 7, POSE)), "lamps", "none is received", "covered"),
    "lamps that are all dead": (
        broken(heard=Heard("agv", 7, POSE, lamps={(6, 4): 8, (7, 5): 8})),
        "lamps",
        "none is received",
        "covered",
    ),
    "unsurveyed lamp": (broken(heard=ODD), "lamps", "code 9 is received, but no lamp", "add it"),
    "dead lamp": (broken(heard=ODD), "lamps", "code 6 (lamp 4) is expected here", "switch it on or replace it"),
    "moved lamp": (broken(heard=ODD), "lamps", "code 7 (lamp 5) differs from its survey", "survey it again"),
}


@pytest.mark.parametrize("name", CASES)
def test_what_is_broken_is_named_with_what_to_do(name: str, file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make, about, text, remedy = CASES[name]
    assert asked(file, make(), as_json=True) == console.FAILED
    found = json.loads(capsys.readouterr().out)
    wrong = [one for one in found if one["level"] == "fix"]
    assert any(one["about"] == about and text in one["text"] and remedy in one["remedy"] for one in wrong), wrong
    assert all(one["remedy"] for one in wrong)


def test_a_lamp_that_is_missing_is_not_in_view(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(file, Computer(heard=ODD)) == console.FAILED
    assert "4 in view, 1 used" in capsys.readouterr().out


REMARKS = {
    "cold": (broken(warmth=None), "kernels", "lumiloop warm"),
    "kernels damaged": (broken(warmth=Warmth(True, 3.0, damaged=2)), "kernels", "check the disk"),
    "not synchronised": (broken(follows=False), "clock", "timedatectl"),
    "no real time": (broken(rights=False), "real time", "LimitRTPRIO"),
    "not running": (broken(), "lamps", "start the daemon"),
}


@pytest.mark.parametrize("name", REMARKS)
def test_what_works_worse_than_it_could_is_a_note(name: str, file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    make, about, remedy = REMARKS[name]
    assert asked(file, make(), as_json=True) == console.OK
    found = json.loads(capsys.readouterr().out)
    assert any(f["about"] == about and f["level"] == "remark" and remedy in f["remedy"] for f in found)


def test_the_first_to_fix_is_named_last(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(file, Computer(ttys=[], room=0, ports={1502: errno.EADDRINUSE})) == console.FAILED
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.startswith("4 to fix. Fix first: disk: free disk space")


def test_files_that_are_wrong(file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file.write_text(CONFIG + "lidar.devise = 3\n")
    assert asked(file, Computer()) == console.USAGE
    assert "devise" in capsys.readouterr().out
    file.write_text(CONFIG + 'map.folder = "lumiloop.toml"\n')
    assert asked(file, Computer()) == console.FAILED
    assert "this is not a folder" in capsys.readouterr().out
    (tmp_path / "lights.toml").write_text("lamp = 5")
    file.write_text(CONFIG)
    assert asked(file, Computer()) == console.FAILED
    assert re.search(r"FIX +survey", capsys.readouterr().out)


def test_another_sensor_than_the_one_configured(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert asked(file, Computer(), "lidar.device=auto:H1") == console.FAILED
    assert "serial H0906091, but H1 is configured" in capsys.readouterr().out


def test_lines_receivers_and_mounts_are_looked_at(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ("modbus.serial=/dev/ttyS99@9600,8N1", 'pose.receivers=["nohost:5600", "*:5601"]', "lidar.mount.x=20")
    assert asked(file, Computer(missing={"/dev/ttyS99"}), *words) == console.FAILED
    said = capsys.readouterr().out
    assert re.search(r"FIX +modbus +/dev/ttyS99: no such device", said)
    assert re.search(r"FIX +receivers +nohost:5600: Name or service not known", said)
    assert re.search(r"note +configuration +`lidar.mount.x` = 20: check the unit, metres", said)
    assert asked(file, Computer(), words[0]) == console.OK


def test_a_folder_that_cannot_be_made_is_not_a_full_disk(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file.write_text(CONFIG + 'map.folder = "/proc/maps"\n')
    assert asked(file, Computer(room=0)) == console.FAILED
    said = capsys.readouterr().out
    assert "FIX  maps" in said
    assert "/proc/maps: this user cannot create the folder" in said
    assert "where /proc" not in said


@pytest.mark.parametrize(
    ("heard", "verdict"), [("no daemon listens there", "FIX"), (Heard("lumiloop", 77, POSE), "good")]
)
def test_a_folder_that_another_daemon_has_is_to_be_fixed_and_our_own_daemons_is_not(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], heard: Heard | str, verdict: str
) -> None:
    other = Store(tmp_path / "maps")
    other.claim()
    asked(file, Computer(heard=heard), f"map.folder={tmp_path / 'maps'}")
    words = rf"{verdict} +maps +.*process {os.getpid()} stores its maps there"
    assert re.search(words, capsys.readouterr().out)
    other.close()


def test_maps_are_judged_by_what_they_are_and_not_by_their_names(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "rooms that cannot be entered"
    folder.mkdir()
    file.write_text(f'{CONFIG}map.folder = "{folder}"\n')
    assert asked(file, Computer()) == console.OK
    assert re.search(r"good +maps +.*no map in it yet", capsys.readouterr().out)
    (folder / "00000001-1.lumimap").write_bytes(b"no map")
    assert asked(file, Computer()) == console.FAILED
    assert re.search(r"FIX +maps +.*no map in it can be used", capsys.readouterr().out)


def test_a_running_daemon_is_listened_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("daemon.diagnosis.host.LISTEN_S", 1.0)
    with served(tmp_path / "s"):
        heard = Host().listen(tmp_path / "s")
    assert isinstance(heard, Heard)
    assert heard.name == "agv"
    assert heard.pose is not None
    assert heard.lamps == {(5, 12): 1, (6, None): 7}
    why = Host().listen(tmp_path / "none")
    assert isinstance(why, str)
    assert "no daemon listens" in why


def test_the_computer_itself_answers() -> None:
    host = Host()
    assert host.synchronised() in (True, False, None)
    assert host.free_bytes(Path("/no/such/folder")) > 0
    assert host.user()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        sock.bind(("127.0.0.1", 0))
        port = sock.getsockname()[1]
        why = host.taken(socket.SOCK_DGRAM, "127.0.0.1", port)
        assert why is not None
        assert why.errno == errno.EADDRINUSE
    assert host.taken(socket.SOCK_DGRAM, "127.0.0.1", port) is None
    assert host.resolved("127.0.0.1") == ""
    assert host.resolved("no host") != ""
    assert host.realtime() in (True, False)
    assert isinstance(host.lidars(), list)
    assert isinstance(host.buses(), list)


def test_a_daemon_that_cannot_be_heard_is_there_all_the_same(
    file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Its devices are in use: to open them would disturb a robot that drives."""
    monkeypatch.setattr("daemon.diagnosis.host.LISTEN_S", 0.2)
    with socket.socket(socket.AF_UNIX) as hung:
        hung.bind(str(tmp_path / "s"))
        hung.listen()
        heard = Host().listen(tmp_path / "s")
    assert isinstance(heard, Mute)
    assert "a daemon is present, but its data cannot be used" in heard.text
    assert isinstance(Host().listen(tmp_path / "s"), str), "a socket that is left over is no daemon"

    def closed(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr("daemon.diagnosis.host._reach", closed)
    heard = Host().listen(tmp_path / "none")
    assert isinstance(heard, Mute)
    assert "usermod -aG lumiloop-stream" in heard.remedy

    class Opened(Computer):
        def lidar_at(self, device: str) -> Finding:
            raise AssertionError("the daemon's lidar was opened")

        def chips_on(self, bus: str) -> BusFinding:
            raise AssertionError("the daemon's bus was opened")

    assert asked(file, Opened(heard=heard)) == console.FAILED
    said = capsys.readouterr().out
    assert "1 to fix. Fix first: daemon: sudo usermod" in said


@pytest.mark.parametrize("use", [3, 8])
def test_a_lamp_in_a_passing_shadow_is_nothing_to_fix(file: Path, capsys: pytest.CaptureFixture[str], use: int) -> None:
    shaded = Heard("agv", 7, POSE, lamps={(5, 3): 1, (7, 5): use})
    asked(file, Computer(heard=shaded))
    said = capsys.readouterr().out
    assert not re.search(r"FIX +lamps", said)
    assert "at present" in said


def test_what_follows_from_a_fault_is_no_second_thing_to_fix(file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    slow = Fault(fault=306, meaning="too slow", remedy="reduce the load")
    stalled = Fault(fault=301, meaning="stalled", remedy="reduce the load", cause=306)
    asked(file, Computer(heard=Heard("agv", 7, POSE, Faults(present=(slow, stalled)))))
    said = capsys.readouterr().out
    assert re.search(r"FIX +daemon +fault 306: too slow", said)
    assert re.search(r"note +daemon +fault 301 follows from fault 306: stalled", said)
    assert said.count("reduce the load") == 1 + said.endswith("daemon: reduce the load\n")
