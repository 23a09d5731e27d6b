"""Process of this computer that owns a port, and whether it is the intended daemon.

Modbus does not contain the identity of the daemon. The kernel has it: which process owns the socket, and which one
listens at the local stream. The module uses the standard library only, like the command that needs it.
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
    """Owner of a port and the intended daemon.

    ``pid``: owning process (0: not visible). ``command``: its command line. ``meant``: process of the intended daemon
    (0: none).
    ``apart``: the intended daemon has a network of its own (a container), whose ports others forward.
    """

    pid: int
    command: str
    meant: int
    apart: bool = False

    @property
    def another(self) -> bool:
        """Whether the owner is another daemon than the intended one, which runs without the port."""
        return 0 not in (self.pid, self.meant) and self.pid != self.meant and not self.apart

    def __str__(self) -> str:
        if not self.pid:
            return ""
        passed_on = f" (the configured name belongs to process {self.meant} in another network namespace)"
        said = f"process {self.pid}" + (f": {self.command}" if self.command else "")
        return said + (passed_on if self.apart and self.pid != self.meant else "")


def whose(of: str | Path, host: str, port: int) -> Whose:
    """Owner of a UDP port of this computer, and the daemon of that name or stream; invisible ones are 0."""
    meant = _listener(of if isinstance(of, Path) else stream_path(of))
    inodes = _sockets(host, port)
    holders = dict(_holders(inodes))
    pid = 0
    if meant in holders:
        pid = meant
    elif inodes == set().union(*holders.values()):  # otherwise an invisible process may be the owner
        pid = next(iter(holders), 0)
    return Whose(pid, _command(pid), meant, _apart(meant))


def _listener(path: Path) -> int:
    """Process that listens at a local socket."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as sock, contextlib.suppress(OSError):
        sock.settimeout(_PATIENCE_S)
        sock.connect(str(path))
        pid: int = _CREDENTIALS.unpack(sock.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))[0]
        return pid
    return 0


def _sockets(host: str, port: int) -> set[str]:
    """Inodes of the UDP sockets that receive datagrams to an address and a port.

    The kernel's order applies: sockets bound to the address itself first, then those of every address, then those of
    the other family, which also receive IPv4.
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
    """An address in usual notation; the kernel's tables contain it as words in the computer's byte order."""
    words = [int(address[at : at + 8], 16) for at in range(0, len(address), 8)]
    family = socket.AF_INET if len(words) == 1 else socket.AF_INET6
    return socket.inet_ntop(family, b"".join(word.to_bytes(4, sys.byteorder) for word in words))


def _holders(inodes: set[str]) -> Iterator[tuple[int, set[str]]]:
    """Processes that have some of these sockets open, with the sockets, as far as permissions show."""
    names = {f"socket:[{inode}]": inode for inode in inodes}
    for process in PROC.iterdir() if names else ():
        if process.name.isdecimal():
            with contextlib.suppress(OSError):
                if held := {names[link] for file in (process / "fd").iterdir() if (link := _link(file)) in names}:
                    yield int(process.name), held


def _apart(pid: int) -> bool:
    """Whether a process is in a network namespace other than this one."""
    theirs, ours = (_link(PROC / who / "ns" / "net") for who in (str(pid), "self"))
    return bool(theirs) and bool(ours) and theirs != ours


def _link(file: Path) -> str:
    try:
        return str(file.readlink())
    except OSError:  # closed meanwhile, or another user's
        return ""


def _command(pid: int) -> str:
    """Command line of a process; characters that might control the terminal are escaped."""
    line = ""
    with contextlib.suppress(OSError):
        if pid:
            line = (PROC / str(pid) / "cmdline").read_bytes().replace(b"\0", b" ").decode(errors="replace").strip()
    return "".join(char if char.isprintable() else repr(char)[1:-1] for char in line)
