"""Claims of the addresses of a remote bus: one lumiloop of this computer at a time uses a converter.

Two programs that read blocks of one converter would delay each other, and each would measure a slow converter. A claim
is a listening socket in the abstract namespace of unix sockets: it needs no file, it ends with the process however that
ends, and the kernel gives the holder's process number. Local buses are locked at their device node instead
(:mod:`hal.bus.i2c_linux`).
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import socket
import struct
from typing import Final

_PEER: Final = struct.Struct("3i")  # unix(7), SO_PEERCRED: process, user, group


def taken(address: int, process: int = 0) -> OSError:
    """The error of an address that another lumiloop has claimed; ``process`` 0: its number is not known."""
    who = f"another lumiloop (process {process})" if process else "another lumiloop or its bus server"
    return OSError(errno.EBUSY, f"{who} uses address {address:#04x} of this bus already")


class AddressLocks:
    """The claims of one open bus; advisory: other programs are not stopped.

    Args:
        bus: name of the bus. The same path by another name (a link) is the same bus.
    """

    def __init__(self, bus: str) -> None:
        kind, _, path = bus.partition(":")
        name = f"unix:{os.path.realpath(path)}" if kind == "unix" else bus.lower()
        self._name = hashlib.sha256(name.encode()).hexdigest()[:32]
        self._held: dict[int, socket.socket] = {}

    def claim(self, address: int) -> None:
        """Claim an address until :meth:`release`; does nothing where it is claimed by this bus already.

        Raises:
            OSError: EBUSY, another open bus holds the claim; the text names its process.
        """
        if address in self._held:
            return
        where = f"\0lumiloop-i2c-{self._name}-{address:02x}"
        holder = socket.socket(socket.AF_UNIX)
        try:
            holder.bind(where)
            holder.listen(1)
        except OSError as error:
            holder.close()
            if error.errno == errno.EADDRINUSE:
                raise taken(address, _process_at(where)) from None
            return  # a host without abstract sockets: no claims
        self._held[address] = holder

    def release(self) -> None:
        """Release all claims; idempotent, and callable from another thread."""
        while self._held:
            with contextlib.suppress(KeyError):
                self._held.popitem()[1].close()


def _process_at(where: str) -> int:
    """Number of the process that listens there; 0 where it is not known."""
    with socket.socket(socket.AF_UNIX) as caller:
        caller.setblocking(False)
        try:
            caller.connect(where)
            found = caller.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _PEER.size)
        except OSError:  # it has ended meanwhile, or its queue is full
            return 0
    return int(_PEER.unpack(found)[0])
