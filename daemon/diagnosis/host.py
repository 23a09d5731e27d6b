"""Host interface of the checks: the computer, its devices, and a running daemon. Tests replace it."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import resource
import shutil
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from daemon.config.schema import PhotodiodeConfig
from daemon.health.faults import Fault
from daemon.publish.stream.client import Stream
from daemon.publish.stream.messages import Faults, Hello, Lights, NotTheStream, Pose, StateChange
from daemon.runtime.warmup import Warmth, is_warm, load
from daemon.snapshot import LinkUse
from hal.bus import i2c_linux
from hal.bus.opening import open_bus
from hal.hokuyo import discover
from hal.hokuyo.probe import Finding, identify_at
from hal.photodiode.probe import BusFinding, probe_bus
from hal.port.opening import open_port

LISTEN_S: Final = 3.0
LISTENERS: Final = "lumiloop-stream"
"""Group with access to the service's stream."""
TIME_ERROR: Final = 5
"""Result of adjtimex(2) for a clock that is not synchronised."""
_TIMEX_BYTES: Final = 512  # more than struct timex on any architecture


@dataclass(slots=True)
class Heard:
    """Data received from a running daemon: latest pose, faults, and the last use of every lamp.

    ``lamps``: (code, lamp ID or None) to the use, as `daemon.snapshot.LinkUse` numbers it.
    """

    name: str = ""
    pid: int = 0
    pose: Pose | None = None
    faults: Faults | None = None
    lights: Lights | None = None
    lamps: dict[tuple[int, int | None], int] = field(default_factory=dict)


SAID_AS: Final[dict[int, int]] = {LinkUse.MISSING: Fault.LAMP_DEAD, LinkUse.REJECTED: Fault.LAMP_MOVED}
"""Fault that a running daemon raises once a lamp has had this use for long (`daemon.integrity.lamp_monitor`)."""


def standing(heard: Heard) -> Callable[[int], bool]:
    """Returns a test for a lasting use of a lamp.

    A dead or moved lamp needs the fault; otherwise it may be a passing shadow.
    """
    present = set() if heard.faults is None else {one.fault for one in heard.faults.present}
    return lambda use: use not in SAID_AS or SAID_AS[use] in present


@dataclass(frozen=True, slots=True)
class Mute:
    """A running daemon without readable data: cause and remedy."""

    text: str
    remedy: str


class Host:
    """The computer that the program runs on."""

    def utc(self) -> float:
        """Calendar time of the computer, s since the Unix epoch."""
        return time.time()

    def synchronised(self) -> bool | None:
        """True if the calendar follows a time server; None if the system does not report it."""
        try:
            state = int(ctypes.CDLL(None, use_errno=True).adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)))
        except (OSError, AttributeError):
            return None
        return None if state < 0 else state != TIME_ERROR

    def user(self) -> str:
        """Name of the present user, or the number without a name."""
        import pwd

        try:
            return pwd.getpwuid(os.geteuid()).pw_name
        except KeyError:
            return str(os.geteuid())

    def exists(self, path: str) -> bool:
        """True if the path exists."""
        return Path(path).exists()

    def usable(self, path: str) -> bool:
        """True if the present user may read and write the path."""
        return os.access(path, os.R_OK | os.W_OK)

    def lidars(self) -> list[str]:
        """Ports that may have a HOKUYO."""
        return discover.candidates()

    def buses(self) -> list[str]:
        """I2C buses of this computer."""
        return list(i2c_linux.buses())

    def lidar_at(self, device: str) -> Finding:
        """Identifies the device at a port."""
        return asyncio.run(identify_at(open_port, device))

    def chips_on(self, bus: str) -> BusFinding:
        """Returns the devices that respond on a bus."""
        return asyncio.run(probe_bus(open_bus, bus))

    def free_bytes(self, folder: Path) -> int:
        """Free room, bytes, on the disk of a folder or of its nearest existing parent."""
        while not folder.exists() and folder != folder.parent:
            folder = folder.parent
        return shutil.disk_usage(folder).free

    def resolved(self, host: str) -> str:
        """Returns why a host name has no address; empty if it has one, or is one."""
        try:
            socket.getaddrinfo(host, None)
        except OSError as error:
            return error.strerror or str(error)
        return ""

    def taken(self, kind: socket.SocketKind, host: str, port: int) -> OSError | None:
        """Returns why a server could not listen there; None if it could."""
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, kind) as sock:
            if kind is socket.SOCK_STREAM:
                sock.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                sock.bind((host, port))
            except OSError as error:
                return error
        return None

    def warm(self, photodiode: PhotodiodeConfig) -> Warmth | None:
        """Load the kernels of this version; None if no earlier start has compiled them here.

        A damaged one is compiled again, as at a start.

        Raises:
            CannotLoad: there is no folder for them, or they cannot be loaded.
        """
        from daemon.devices.light_setup import Lights
        from daemon.devices.photodiode import profile_of
        from estimator import Survey

        if not is_warm(photodiode.fitted):
            return None
        return load(Lights(Survey(), profile_of(photodiode)) if photodiode.fitted else None)

    def realtime(self) -> bool:
        """True if the present user may set a real-time priority."""
        return os.geteuid() == 0 or resource.getrlimit(resource.RLIMIT_RTPRIO)[0] > 0

    def listen(self, path: Path) -> Heard | Mute | str:
        """Receives the stream of a running daemon for some seconds; a text: why there is none."""
        heard = asyncio.run(_listen(path))
        return heard if isinstance(heard, Heard) else self._mute(path, heard) or heard

    def _mute(self, path: Path, why: str) -> Mute | None:
        """Returns the daemon at a path that has sent no data; None if there is none."""
        try:
            _reach(path)
        except PermissionError:
            text = f"{path}: {self.user()} has no access, so its state is unknown"
            return Mute(text, f"sudo usermod -aG {LISTENERS} {self.user()}, then log in again; or run this as root")
        except OSError:
            return None
        text = f"{path}: a daemon is present, but its data cannot be used: {why}"
        return Mute(text, "it does not respond or has another version; read its log")


def _reach(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as sock:
        sock.settimeout(LISTEN_S)
        sock.connect(str(path))


async def _listen(path: Path) -> Heard | str:
    heard, why = Heard(), ""
    stream = Stream(path, ("pose", "faults", "lights", "state"), patient=False)
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LISTEN_S), contextlib.aclosing(stream.frames()) as frames:
            try:
                async for frame in frames:
                    match frame:
                        case Hello():
                            heard.name, heard.pid = frame.name, frame.pid
                        case Pose():
                            heard.pose = frame
                        case Faults():
                            heard.faults = frame
                        case Lights():
                            heard.lights = frame
                            heard.lamps |= {(link.code, link.lamp_id): link.use for link in frame.links}
                        case StateChange():
                            continue
                        case _:
                            why = getattr(frame, "text", "")
            except NotTheStream as error:
                why = str(error)
    return heard if heard.pid else why or "no reply"
