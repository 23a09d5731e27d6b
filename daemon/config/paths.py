"""Where the daemon keeps things: what it learns, its maps, its sockets."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Final

SERVICE: Final = Path("/run/lumiloop")
"""The service manager's RuntimeDirectory."""
LOCAL_SOCKETS: Final = Path("/proc/net/unix")
ACCEPTS: Final = 0x10000
"""The flag of a socket that is listened on (__SO_ACCEPTCON)."""
SERVICE_STATE: Final = Path("/var/lib/lumiloop")
"""The service manager's StateDirectory."""


def recordings_folder(name: str) -> Path:
    """Where a folder of that name is in which the flight recorder writes: below our state, else below the service's."""
    own, service = state_folder() / name, SERVICE_STATE / name
    return service if _there(service) and not _there(own) else own


def state_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where what is learned is kept: the service manager's StateDirectory, else the user's own."""
    if named := environment.get("STATE_DIRECTORY", "").partition(":")[0]:
        return Path(named)
    home = environment.get("XDG_STATE_HOME") or str(Path(environment.get("HOME", "/")) / ".local" / "state")
    return Path(home) / "lumiloop"


def runtime_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Where sockets are: the service manager's RuntimeDirectory, else the user's own, else beside what is learned."""
    if named := environment.get("RUNTIME_DIRECTORY", "").partition(":")[0]:
        return Path(named)
    user = environment.get("XDG_RUNTIME_DIR", "")
    return Path(user) / "lumiloop" if user else state_folder(environment)


def stream_path(name: str) -> Path:
    """Where the daemon of that ``name`` (of the configuration) serves its local stream: ours, else the service's."""
    own, service = runtime_folder() / f"{name}.stream", SERVICE / f"{name}.stream"
    return service if _there(service) and not _there(own) else own


def streams_served(name: str) -> list[Path]:
    """The local streams that daemons of that ``name`` serve on this computer now: ours, the service's."""
    paths = [folder / f"{name}.stream" for folder in dict.fromkeys((runtime_folder(), SERVICE))]
    return [path for path in paths if _served(path)]


def daemons_in(folder: Path) -> list[str]:
    """Names of the daemons whose local streams are served in a folder."""
    try:
        return sorted(path.stem for path in folder.glob("*.stream") if _served(path))
    except OSError:
        return []


def _served(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock:
        sock.setblocking(False)
        try:
            sock.connect(str(path))
        except PermissionError:  # another user's, or in a folder that is not open to us
            return _listened_on(path)
        except OSError:
            return False
    return True


def _listened_on(path: Path) -> bool:
    """Whether somebody listens on a local socket, by the kernel's table, which is open to everybody (proc_net(5))."""
    with contextlib.suppress(OSError):
        rows = [line.split(maxsplit=7) for line in LOCAL_SOCKETS.read_text(errors="surrogateescape").splitlines()]
        return any(row[7:] == [str(path)] and int(row[3], 16) & ACCEPTS for row in rows)
    return False


def _there(path: Path) -> bool:
    """Whether it exists, or may: what lies in a folder that is not open to us is said when it is opened."""
    try:
        return path.exists()
    except PermissionError:  # also for a moment while the service starts, until its folder belongs to our group
        return True


def can_be_made(folder: Path) -> bool:
    """Whether a folder that is not there could be made by this user, as far as rights tell."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    stores = folder.is_dir() and os.statvfs(folder).f_blocks > 0  # else files in it are not files, as in /proc
    return stores and os.access(folder, os.W_OK | os.X_OK)


def maps_folder(configured: str) -> Path:
    """Where maps are kept: as ``map.folder`` says, else beside what is learned."""
    return Path(configured) if configured else state_folder() / "maps"
