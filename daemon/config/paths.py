"""Folders and sockets of the daemon: learned state, maps, recordings and local streams."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from typing import Final

SERVICE: Final = Path("/run/lumiloop")
"""RuntimeDirectory of the service."""
LOCAL_SOCKETS: Final = Path("/proc/net/unix")
ACCEPTS: Final = 0x10000
"""Flag of a listening socket in the kernel's table (__SO_ACCEPTCON)."""
SERVICE_STATE: Final = Path("/var/lib/lumiloop")
"""StateDirectory of the service."""


def recordings_folder(name: str) -> Path:
    """Flight recorder folder of that name: below this user's state folder, else the service's."""
    own, service = state_folder() / name, SERVICE_STATE / name
    return service if _there(service) and not _there(own) else own


def state_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Folder of learned state: the service manager's StateDirectory, else the user's own."""
    if named := environment.get("STATE_DIRECTORY", "").partition(":")[0]:
        return Path(named)
    home = environment.get("XDG_STATE_HOME") or str(Path(environment.get("HOME", "/")) / ".local" / "state")
    return Path(home) / "lumiloop"


def runtime_folder(environment: Mapping[str, str] = os.environ) -> Path:
    """Folder of sockets: the service manager's RuntimeDirectory, else the user's own, else the state folder."""
    if named := environment.get("RUNTIME_DIRECTORY", "").partition(":")[0]:
        return Path(named)
    user = environment.get("XDG_RUNTIME_DIR", "")
    return Path(user) / "lumiloop" if user else state_folder(environment)


def stream_path(name: str) -> Path:
    """Socket of the local stream of the daemon with that configured ``name``: this user's, else the service's."""
    own, service = runtime_folder() / f"{name}.stream", SERVICE / f"{name}.stream"
    return service if _there(service) and not _there(own) else own


def commands_beside(stream: Path) -> Path:
    """Socket at which the daemon with that local stream takes commands."""
    return stream.with_name(f"{stream.name.removesuffix('.stream')}.commands")


def streams_served(name: str) -> list[Path]:
    """Local streams that daemons of that ``name`` serve on this computer now: this user's, then the service's."""
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
        except PermissionError:  # another user's socket, or a folder without permission
            return _listened_on(path)
        except OSError:
            return False
    return True


def _listened_on(path: Path) -> bool:
    """Whether a process listens on a local socket, by the kernel's table, which every user may read (proc_net(5))."""
    with contextlib.suppress(OSError):
        rows = [line.split(maxsplit=7) for line in LOCAL_SOCKETS.read_text(errors="surrogateescape").splitlines()]
        return any(row[7:] == [str(path)] and int(row[3], 16) & ACCEPTS for row in rows)
    return False


def _there(path: Path) -> bool:
    """Whether the file exists, or may exist.

    Without permission to look, the error is reported when the file is opened.
    """
    try:
        return path.exists()
    except PermissionError:  # also for a moment during the service's start, until the folder has its group
        return True


def can_be_made(folder: Path) -> bool:
    """Whether this user could create a missing folder, as far as permissions show."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    stores = folder.is_dir() and os.statvfs(folder).f_blocks > 0  # otherwise it is not a real file system, like /proc
    return stores and os.access(folder, os.W_OK | os.X_OK)


def maps_folder(configured: str) -> Path:
    """Folder of maps: ``map.folder`` where configured, otherwise beside the learned state."""
    return Path(configured) if configured else state_folder() / "maps"


def stored_maps(configured: str) -> Path:
    """Folder of maps for a command beside the daemon: as `maps_folder`, or the service's.

    The service's is taken where this user has no folder of maps and may read that one, as with sudo.
    """
    own, service = maps_folder(configured), SERVICE_STATE / "maps"
    readable = not configured and os.access(service, os.R_OK | os.X_OK)
    return service if readable and not _there(own) else own
