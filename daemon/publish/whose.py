"""Who on this computer answers at a port, and whether that is the daemon that was meant.

Modbus does not say whose registers it shows. The kernel knows: who has the socket, and who listens at the local stream.
Standard library only, as the command that asks.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.folders import stream_path

PROC: Final = Path("/proc")
_CREDENTIALS: Final = struct.Struct("3i")  # of a peer: process, user, group
_PATIENCE_S: Final = 0.5
_EVERYWHERE: Final = ("0.0.0.0", "::")


@dataclass(frozen=True, slots=True)
class Whose:
    """Who answers: process ``pid``, 0: not to be seen, started by ``command``; ``meant``: that of the name, 0: none."""

    pid: int
    command: str
    meant: int

    @property
    def another(self) -> bool:
        """Whether it is another daemon than the one that was meant, which runs and has not got the port."""
        return 0 not in (self.pid, self.meant) and self.pid != self.meant

    def __str__(self) -> str:
        return f"process {self.pid}" + (f": {self.command}" if self.command else "") if self.pid else ""


def whose(name: str, host: str, port: int) -> Whose:
    """Who answers at a UDP port of this computer, and who is the daemon of that name; what cannot be seen is 0."""
    meant = _listener(stream_path(name))
    holders = list(_holders(set(_sockets(host, port))))
    pid = meant if meant in holders else next(iter(holders), 0)
    return Whose(pid, _command(pid), meant)


def _listener(path: Path) -> int:
    """The process that listens at a local socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock, contextlib.suppress(OSError):
        sock.settimeout(_PATIENCE_S)
        sock.connect(str(path))
        pid: int = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0]
        return pid
    return 0


def _sockets(host: str, port: int) -> Iterator[str]:
    """The inodes of UDP sockets that are bound to an address and a port, or to the port on every address."""
    for table in ("udp", "udp6"):
        with contextlib.suppress(OSError):
            for line in (PROC / "net" / table).read_text().splitlines()[1:]:
                words = line.split()
                address, _, number = words[1].partition(":")
                if int(number, 16) == port and _written(address) in (host, *_EVERYWHERE):
                    yield words[9]


def _written(address: str) -> str:
    """An address as people write it; the kernel's tables have it in words of the computer's own byte order."""
    words = [int(address[at : at + 8], 16) for at in range(0, len(address), 8)]
    family = socket.AF_INET if len(words) == 1 else socket.AF_INET6
    return socket.inet_ntop(family, b"".join(word.to_bytes(4, sys.byteorder) for word in words))


def _holders(inodes: set[str]) -> Iterator[int]:
    """The processes that have one of these sockets open, as far as we may look into them."""
    names = {f"socket:[{inode}]" for inode in inodes}
    for process in PROC.iterdir() if names else ():
        if process.name.isdecimal():
            with contextlib.suppress(OSError):
                if any(_link(file) in names for file in (process / "fd").iterdir()):
                    yield int(process.name)


def _link(file: Path) -> str:
    try:
        return str(file.readlink())
    except OSError:  # closed meanwhile
        return ""


def _command(pid: int) -> str:
    with contextlib.suppress(OSError):
        if pid:
            return (PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    return ""
