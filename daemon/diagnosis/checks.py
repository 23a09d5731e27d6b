"""Checks of `lumiloop doctor`: each examines one part of the installation; listed in the order of repair."""

from __future__ import annotations

import errno
import os
import socket
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Final

from daemon.config.endpoints import ANYBODY, AUTO, is_bus, parse_endpoint, subscription_port
from daemon.config.loader import naming
from daemon.config.paths import can_be_made, runtime_folder, state_folder, stored_maps, stream_path
from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError, read_survey
from daemon.diagnosis.configuration import implausible
from daemon.diagnosis.host import Heard, Host, Mute, standing
from daemon.diagnosis.map_folder import Maps, look_at_maps
from daemon.runtime.warmup import CannotLoad
from daemon.snapshot import LinkUse, State
from hal.net.inet import refusal

FREE_BYTES: Final = 200 << 20
"""Required free room, bytes: a map of a large building, twice, and some recording."""
FIRST_UTC: Final = 1_735_689_600.0
"""Start of 2025, s of UTC: an earlier calendar means that the clock was never set."""
GROUPS: Final = {"i2c": "i2c", "tty": "dialout"}
NOT_RUNNING: Final = "start it with `lumiloop run` or as a service; the log states why it ended"


class Level(IntEnum):
    """Severity of a finding."""

    GOOD = 0
    REMARK = 1
    FIX = 2


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check: subject, severity, text, and remedy (empty if none is needed)."""

    about: str
    level: Level
    text: str
    remedy: str = ""


@dataclass(frozen=True, slots=True)
class Case:
    """Input of the checks.

    Attributes:
        settings: the configuration. file: its path, None: built-in values. host: the computer.
        heard: data from the running daemon; `Mute`: a daemon without readable data; a text: why there is none.
    """

    settings: Config
    file: Path | None
    host: Host
    heard: Heard | Mute | str

    @property
    def runs(self) -> bool:
        """True if a daemon of this name is running; its devices and ports are then in use."""
        return isinstance(self.heard, Heard | Mute)


Check = Callable[[Case], Iterator[Finding]]


def good(about: str, text: str) -> Finding:
    """Returns a finding without a defect."""
    return Finding(about, Level.GOOD, text)


def remark(about: str, text: str, remedy: str = "") -> Finding:
    """Returns a finding that works but needs attention."""
    return Finding(about, Level.REMARK, text, remedy)


def fix(about: str, text: str, remedy: str) -> Finding:
    """Returns a finding that must be repaired."""
    return Finding(about, Level.FIX, text, remedy)


def configuration(case: Case) -> Iterator[Finding]:
    """Checks the configuration; an unreadable file ends the doctor before this check."""
    about = "configuration"
    if case.file is None:
        yield remark(
            about, "none was found; the doctor checks the built-in values", "name the daemon's file with --config FILE"
        )
    else:
        yield good(about, str(case.file))
    for said in implausible(case.settings.lidar.mount):
        yield remark(about, said, "correct the value if it is wrong")


def clock(case: Case) -> Iterator[Finding]:
    """Checks the calendar: poses carry UTC, but the estimate itself does not need it."""
    if case.host.utc() < FIRST_UTC:
        yield fix("clock", "is set to a year before 2025", "set it, or start a time service: timedatectl set-ntp true")
    elif case.host.synchronised() is False:
        yield remark(
            "clock",
            "is not synchronised to a time server; UTC stamps drift, poses do not",
            "run `timedatectl set-ntp true`, or install chrony",
        )
    else:
        yield good("clock", "is set" + (" and synchronised to a time server" if case.host.synchronised() else ""))


def cache(case: Case) -> Iterator[Finding]:
    """Checks the compiled kernels by loading them."""
    try:
        warmth = case.host.warm(case.settings.photodiode)
    except CannotLoad as error:
        yield fix("kernels", str(error), "give the daemon a folder with write access")
        return
    if warmth is None:
        text = "of this version are not compiled for this user; the first start takes a minute or two"
        yield remark("kernels", text, "run `lumiloop warm` once")
    elif warmth.unwritten:
        text = f"were missing or damaged and cannot be stored ({warmth.unwritten}); each start compiles them"
        yield fix("kernels", text, "free disk space, or name another folder with NUMBA_CACHE_DIR")
    elif warmth.damaged:
        text = f"{warmth.damaged} files were damaged; their kernels are compiled again"
        yield remark("kernels", text, "no action is needed after a power cut; if it happens again, check the disk")
    else:
        yield good("kernels", f"are compiled, and load in {warmth.seconds:.1f} s")


def disk(case: Case) -> Iterator[Finding]:
    """Checks the room for maps and recordings."""
    for folder in filter(can_be_made, {_maps(case.settings) or state_folder(), state_folder()}):
        free = case.host.free_bytes(folder)
        if free < FREE_BYTES:
            text = f"{free >> 20} MB are free at {folder}; maps cannot be saved on a full disk"
            yield fix("disk", text, f"free disk space there, or set `map.folder`; {FREE_BYTES >> 20} MB are enough")
            return
    yield good("disk", "has enough free space")


def lidar(case: Case) -> Iterator[Finding]:
    """Checks the lidar: present, accessible, and a HOKUYO."""
    if not case.settings.lidar.fitted:
        yield good("lidar", "none is configured")
        return
    if case.runs:
        return  # it is in use; the daemon's own faults cover it
    device = case.settings.lidar.place.device
    named = [device] if device != AUTO else case.host.lidars()
    if not named:
        text = "no serial device that could be a HOKUYO is connected"
        yield fix(
            "lidar", text, 'connect it and switch it on; for an Ethernet model set lidar.device = "tcp://ADDRESS:10940"'
        )
    for name in named:
        finding = _unusable("lidar", name, case.host) or _lidar_at(name, case)
        yield finding
        if finding.level is Level.GOOD:
            return


def _lidar_at(name: str, case: Case) -> Finding:
    found = case.host.lidar_at(name)
    if found.error is not None:
        return fix("lidar", f"{found.device}: {found.error.problem}", found.error.remedy)
    wanted = case.settings.lidar.place.serial
    if wanted and found.geometry is not None and found.geometry.serial != wanted:
        text = f"{name}: serial {found.geometry.serial}, but {wanted} is configured"
        return fix("lidar", text, f'connect that sensor, or set lidar.device = "auto:{found.geometry.serial}"')
    return good("lidar", str(found))


def photodiode(case: Case) -> Iterator[Finding]:
    """Checks the bus of the photodiode, and the converter on it."""
    settings = case.settings.photodiode
    if not settings.fitted:
        yield good("photodiode", "none is configured")
        return
    if case.runs:
        return
    if settings.bus.startswith("/") and (finding := _unusable("photodiode", settings.bus, case.host)):
        yield finding
        return
    found = case.host.chips_on(settings.bus)
    name, _, address = settings.converter.partition("@")
    here = next((chip for chip in found.chips if chip.address == int(address, 0)), None)
    if found.error is not None:
        yield fix("photodiode", f"{found.bus}: {found.error.problem}", found.error.remedy)
    elif here is None:
        others = ", ".join(map(str, found.chips)) or "nothing"
        remedy = "check power, SDA and SCL, or correct `photodiode.converter`"
        yield fix("photodiode", f"{settings.bus}: no {name} at {address}; found: {others}", remedy)
    elif not here.usable or name.lower() not in here.name.lower():
        yield fix("photodiode", f"{settings.bus}: {here}, but {name} is configured", "correct `photodiode.converter`")
    else:
        yield good("photodiode", f"{settings.bus}: {here}")


def _unusable(about: str, device: str, host: Host) -> Finding | None:
    """Returns why a device file cannot be opened; None if it can, or if there is no file."""
    if not device.startswith("/"):
        return None
    if not host.exists(device):
        what = (
            ("enable the bus in the operating system first") if is_bus(device) else "connect it, or name another device"
        )
        return fix(about, f"{device}: no such device", f"{what}; `lumiloop probe` lists the devices that are connected")
    if not host.usable(device):
        group = GROUPS["i2c" if is_bus(device) else "tty"]
        remedy = f"sudo usermod -aG {group} {host.user()}, then log in again"
        return fix(about, f"{device}: access denied for {host.user()}", remedy)
    return None


def ports(case: Case) -> Iterator[Finding]:
    """Checks the ports on which servers listen."""
    settings = case.settings
    wanted: list[tuple[str, socket.SocketKind, int]] = []
    if settings.modbus.port:
        wanted += [("modbus.port", socket.SOCK_STREAM, settings.modbus.port)]
        wanted += [("modbus.port", socket.SOCK_DGRAM, settings.modbus.port)]
    if settings.odometry.port:
        wanted.append(("odometry.port", socket.SOCK_DGRAM, settings.odometry.port))
    if port := subscription_port(settings.pose.receivers):
        wanted.append(("pose.receivers", socket.SOCK_DGRAM, port))
    if case.runs or not wanted:
        return
    bad = False
    for key, kind, port in wanted:
        if why := case.host.taken(kind, settings.bind, port):
            bad = True
            name = "TCP" if kind is socket.SOCK_STREAM else "UDP"
            refused = refusal(name, key, port, why)
            others = why.errno == errno.EADDRINUSE
            remedy = f"`ss -lnp` shows which program uses {port}; or set another {key}" if others else refused.remedy
            yield fix("ports", f"{key}: {name} {settings.bind}:{port}: {refused.problem}", remedy)
    if not bad:
        yield good("ports", "free: " + ", ".join(sorted({f"{key} {port}" for key, _, port in wanted})))


def rtu(case: Case) -> Iterator[Finding]:
    """Checks the serial line for Modbus."""
    line = case.settings.modbus.line
    if line is not None and not case.runs:
        yield _unusable("modbus", line.path, case.host) or good("modbus", f"{line.path} can be opened")


def receivers(case: Case) -> Iterator[Finding]:
    """Checks the host names that receive pose datagrams."""
    for receiver in case.settings.pose.receivers:
        host, _ = parse_endpoint(receiver)
        if host != ANYBODY and (why := case.host.resolved(host)):
            remedy = "correct the name in `pose.receivers`, or write the address; check the network"
            yield fix("receivers", f"{receiver}: {why}", remedy)


def maps(case: Case) -> Iterator[Finding]:
    """Checks the map folder and the initial map."""
    settings = case.settings
    if not settings.map.kept:
        yield remark("maps", "are not stored, because `map.folder` is none")
        return
    found, text = look_at_maps(settings)
    if found is Maps.TAKEN and not case.runs:
        yield fix("maps", text, "end that process, or name another folder in `map.folder`")
    elif found in (Maps.BROKEN, Maps.FROZEN):
        yield fix(
            "maps",
            text,
            "give this user write access, move unusable files away, or name another folder in `map.folder`",
        )
    elif settings.map.localise and found is not Maps.READY:
        yield fix("maps", f"{text}; `map.localise` requires a map", "make a map first, or set map.localise = false")
    else:
        yield good("maps", text)


def _maps(settings: Config) -> Path | None:
    return stored_maps(settings.map.folder) if settings.map.kept else None


def survey(case: Case) -> Iterator[Finding]:
    """Checks the survey file of the lamps."""
    from daemon.devices.photodiode import profile_of

    settings = case.settings
    if not settings.lights.survey:
        if settings.photodiode.fitted:
            yield remark("survey", "none; only lamps that send their own position can be used", "see `lumiloop survey`")
        return
    path = Path(settings.lights.survey)
    try:
        found = read_survey(path, profile_of(settings.photodiode))
    except SurveyError as error:
        named = naming(case.file, "lights.survey", path)
        there = os.path.exists(path)  # noqa: PTH110  Path.exists raises where no file can have that name
        remedy = "correct the file" if there else "create the file, or name another"
        yield fix("survey", f"{error} ({named})", f"{remedy}; then run `lumiloop check`")
        return
    unused = "" if settings.photodiode.fitted else ", not used: photodiode.bus is empty"
    yield good("survey", f"{settings.lights.survey}: {len(found.lamps)} lamps{unused}")


def daemon(case: Case) -> Iterator[Finding]:
    """Reports state and faults of the running daemon, with their remedies."""
    heard = case.heard
    if isinstance(heard, str):
        yield remark("daemon", f"no daemon runs with the name {case.settings.name} ({heard})", NOT_RUNNING)
        return
    if isinstance(heard, Mute):
        yield fix("daemon", heard.text, heard.remedy)
        return
    present = () if heard.faults is None else heard.faults.present
    for fault in present:
        if fault.cause:
            yield remark("daemon", f"fault {fault.fault} follows from fault {fault.cause}: {fault.meaning}")
        else:
            yield fix("daemon", f"fault {fault.fault}: {fault.meaning}", fault.remedy)
    if heard.pose is None:
        yield fix(
            "daemon", f"{heard.name} runs, but publishes no pose", "it is starting or does not respond; read its log"
        )
    elif heard.pose.state in (State.TRACKING, State.MAPPING):
        yield good("daemon", f"{heard.name} runs: {heard.pose.state_name}")
    elif not present:
        yield remark("daemon", f"{heard.pose.state_name}: {heard.pose.meaning}", heard.pose.remedy)


_ODD: Final = {
    LinkUse.UNSURVEYED: ("is received, but no lamp with this code is in the survey", "add it with `lumiloop survey`"),
    LinkUse.MISSING: ("is expected here, but not received", "switch it on or replace it"),
    LinkUse.REJECTED: (
        "differs from its survey",
        "survey it again if it was moved or exchanged; otherwise look for a second lamp with its code",
    ),
    LinkUse.TWIN: ("is received from two lamps", "give one of them another code"),
}


def lamps(case: Case) -> Iterator[Finding]:
    """Compares the received lamps with the survey; needs the daemon."""
    if not case.settings.photodiode.fitted:
        return
    if not isinstance(case.heard, Heard):
        yield remark("lamps", "only a running daemon can check them", "start the daemon and run the doctor again")
        return
    seen = case.heard.lamps
    used = sum(use == LinkUse.ACCEPTED for use in seen.values())
    received = sum(use != LinkUse.MISSING for use in seen.values())
    if not received:
        yield fix(
            "lamps",
            "none is received",
            "check that the lamps are on, that the photodiode is not covered, and that `photodiode.profile` is correct",
        )
    lasts = standing(case.heard)
    for (code, lamp_id), use in sorted(seen.items(), key=lambda one: (one[0][0], one[0][1] or 0)):
        if use in _ODD:
            text, remedy = _ODD[LinkUse(use)]
            named = f"code {code}{'' if lamp_id is None else f' (lamp {lamp_id})'}"
            if lasts(use):
                yield fix("lamps", f"{named} {text}", remedy)
            else:
                yield remark("lamps", f"{named} {text} at present", f"run the doctor again; if it persists: {remedy}")
    if received:
        yield good("lamps", f"{received} in view, {used} used")


def realtime(case: Case) -> Iterator[Finding]:
    """Checks the permission for real-time priority."""
    if case.runs:
        return
    if case.host.realtime():
        yield good("real time", "is available")
    else:
        text = f"{case.host.user()} has no right to real-time priority; cycles can be late on a busy computer"
        yield remark("real time", text, "run the daemon as the systemd service (LimitRTPRIO=50)")


def sockets(case: Case) -> Iterator[Finding]:
    """Checks the folder of the local stream."""
    folder = runtime_folder()
    if not case.runs and case.host.exists(str(folder)) and not case.host.usable(str(folder)):
        remedy = "start the daemon as the owner of the folder, or set RUNTIME_DIRECTORY"
        yield fix("stream", f"{stream_path(case.settings.name)} cannot be made by {case.host.user()}", remedy)


CHECKS: Final[tuple[Check, ...]] = (
    *(configuration, survey, disk, cache, lidar, photodiode),
    *(ports, rtu, receivers, maps, sockets, daemon, lamps, clock, realtime),
)
