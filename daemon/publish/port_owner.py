"""The process of this computer that owns a port, and whether it is the intended daemon.

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

from daemon.config.paths import stream_path

PROC: Final = Path("/proc")
_CREDENTIALS: Final = struct.Struct("3i")  # of a peer: process, user, group
_PATIENCE_S: Final = 0.5


@dataclass(frozen=True, slots=True)
class Whose:
    """Who answers: process ``pid``, 0: not to be seen, started by ``command``; ``meant``: that of the name, 0: none.

    ``apart``: the latter has a network of its own (a container), whose ports others pass on.
    """

    pid: int
    command: str
    meant: int
    apart: bool = False

    @property
    def another(self) -> bool:
        """Whether it is another daemon than the one that was meant, which runs and has not got the port."""
        return 0 not in (self.pid, self.meant) and self.pid != self.meant and not self.apart

    def __str__(self) -> str:
        if not self.pid:
            return ""
        passed_on = f" (the configured name is that of process {self.meant}, which has a network of its own)"
        said = f"process {self.pid}" + (f": {self.command}" if self.command else "")
        return said + (passed_on if self.apart and self.pid != self.meant else "")


def whose(of: str | Path, host: str, port: int) -> Whose:
    """Who answers at a UDP port of this computer, and who is the daemon of that name or stream; unseen ones are 0."""
    meant = _listener(of if isinstance(of, Path) else stream_path(of))
    inodes = _sockets(host, port)
    holders = dict(_holders(inodes))
    pid = 0
    if meant in holders:
        pid = meant
    elif inodes == set().union(*holders.values()):  # else the one that is not to be seen may be who answers
        pid = next(iter(holders), 0)
    return Whose(pid, _command(pid), meant, _apart(meant))


def _listener(path: Path) -> int:
    """The process that listens at a local socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock, contextlib.suppress(OSError):
        sock.settimeout(_PATIENCE_S)
        sock.connect(str(path))
        pid: int = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0]
        return pid
    return 0


def _sockets(host: str, port: int) -> set[str]:
    """The inodes of the UDP sockets that get what is sent to an address and a port.

    As in the kernel those that are bound to the address itself go before those of every address, and these before those
    of the other family, which take IPv4 too.
    """
    bound: dict[str, set[str]] = {}
    for table in ("udp", "udp6"):
        with contextlib.suppress(OSError):
            for line in (PROC / "net" / table).read_text().splitlines()[1:]:
                words = line.split()
                address, _, number = words[1].partition(":")
                if int(number, 16) == port:
                    bound.setdefault(_written(address), set()).add(words[9])
    nearest = (host, "::") if ":" in host else (host, "0.0.0.0", "::")
    return next((bound[address] for address in nearest if address in bound), set())


def _written(address: str) -> str:
    """An address as people write it; the kernel's tables have it in words of the computer's own byte order."""
    words = [int(address[at : at + 8], 16) for at in range(0, len(address), 8)]
    family = socket.AF_INET if len(words) == 1 else socket.AF_INET6
    return socket.inet_ntop(family, b"".join(word.to_bytes(4, sys.byteorder) for word in words))


def _holders(inodes: set[str]) -> Iterator[tuple[int, set[str]]]:
    """The processes that have some of these sockets open, as far as we may look into them, and which."""
    names = {f"socket:[{inode}]": inode for inode in inodes}
    for process in PROC.iterdir() if names else ():
        if process.name.isdecimal():
            with contextlib.suppress(OSError):
                if held := {names[link] for file in (process / "fd").iterdir() if (link := _link(file)) in names}:
                    yield int(process.name), held


def _apart(pid: int) -> bool:
    """Whether a process is known to have another network than this one."""
    theirs, ours = (_link(PROC / who / "ns" / "net") for who in (str(pid), "self"))
    return bool(theirs) and bool(ours) and theirs != ours


def _link(file: Path) -> str:
    try:
        return str(file.readlink())
    except OSError:  # closed meanwhile, or another user's
        return ""


def _command(pid: int) -> str:
    """A process's command line; what is no letter, and might be an order to the terminal, is written out."""
    line = ""
    with contextlib.suppress(OSError):
        if pid:
            line = (PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in line)
