"""Serves an I2C bus over a unix or TCP socket: for a bench, for the simulator, and where exact block times matter.

::

    python -m hal.bus.i2c_server /dev/i2c-1 unix:/run/lumiloop/i2c
    python -m hal.bus.i2c_server adapter:bcm2835 tcp://127.0.0.1:10941

In a process of its own the bus thread does not compete for the interpreter lock, so that its block times are exact. The
bus is opened for each connection: a client that reconnects opens it again. There is no authentication: every client can
write to every chip on the bus. A unix socket is therefore accessible to its owner only, and TCP is served on loopback
addresses only, unless ``--anyone`` is given. From another computer use ``ssh -L 10941:127.0.0.1:10941 ROBOT``.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import errno
import ipaddress
import socket
import stat
import sys
from pathlib import Path
from typing import Final

from hal.bus import i2c_frames as frames
from hal.bus.i2c import AsyncBus, BusOpener, Message, Transferred, check
from hal.bus.i2c_remote import clock_name, parse_address
from hal.bus.opening import open_bus
from hal.clock import Clock, SystemClock
from hal.errors import DeviceRefused, HalError
from hal.net.inet import resolve
from hal.run_server import print_line, until_stopped

AHEAD: Final = 8
"""Most unanswered transactions of a client; its further bytes are not read meanwhile."""
CLIENTS: Final = 8


class BusServer:
    """Serves one bus to several clients; their transactions alternate.

    Args:
        opener: opens the bus, once for each client. bus: its name for the opener. clock: the bus's.
        anyone: also listen on addresses that other computers can reach.
    """

    def __init__(self, opener: BusOpener, bus: str, clock: Clock, *, anyone: bool = False) -> None:
        self._opener, self._bus, self._clock, self._anyone = opener, bus, clock, anyone
        self._clock_name = clock_name() if isinstance(clock, SystemClock) else ""
        self._server: asyncio.Server | None = None
        self._clients: set[asyncio.Task[None]] = set()
        self._path: Path | None = None

    async def listen(self, where: str) -> str:
        """Begin to accept at ``unix:/path`` or ``tcp://host:port``; returns the address (port 0 chooses a free one).

        Raises:
            DeviceMissing: unknown host name.
            DeviceRefused: not an address, in use, not permitted, or open to other computers without ``anyone``.
        """
        address = parse_address(where)
        if not isinstance(address, str) and not self._anyone:
            await _check_loopback(where, *address)
        try:
            if isinstance(address, str):
                _remove_stale_socket(Path(address))
                self._server = await asyncio.start_unix_server(self._accept, sock=_private_socket(address))
                self._path = Path(address)
                return where
            self._server = await asyncio.start_server(self._accept, *address)
        except OSError as error:
            raise DeviceRefused(where, f"cannot listen: {error.strerror or error}", "choose another address") from error
        host, port = self._server.sockets[0].getsockname()[:2]
        return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"

    async def close(self) -> None:
        """Stop accepting, disconnect all clients, remove the socket's file."""
        if self._server is not None:
            self._server.close()
        for task in self._clients:
            task.cancel()
        await asyncio.gather(*self._clients, return_exceptions=True)
        if self._server is not None:
            await self._server.wait_closed()
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    async def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._clients) >= CLIENTS:
            writer.write(
                frames.refused(DeviceRefused(self._bus, f"{CLIENTS} clients are connected already", "end one of them"))
            )
            writer.close()
            return
        task = asyncio.current_task()
        assert task is not None
        self._clients.add(task)
        task.add_done_callback(self._clients.discard)
        with contextlib.suppress(ConnectionError, asyncio.CancelledError):
            await self._serve(reader, writer)
        writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            bus = await self._opener(self._bus)
        except HalError as error:
            writer.write(frames.refused(error))
            await writer.drain()
            return
        try:
            writer.write(frames.hello(self._clock.now(), self._clock_name, bus.about))
            await self._receive(bus, reader, writer)
        finally:
            await bus.close()

    async def _receive(self, bus: AsyncBus, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        orders: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(AHEAD)
        worker = asyncio.create_task(self._work(bus, orders, writer))
        try:
            splitter = frames.Splitter()
            while data := await reader.read(1 << 16):
                received = self._clock.now()
                for kind, body in splitter.feed(data):
                    if kind != frames.TRANSFER:
                        return
                    if not await _put(orders, (received, body), worker):
                        return
        except frames.BadFrame:
            return
        finally:
            worker.cancel()
            await asyncio.gather(worker, return_exceptions=True)

    async def _work(
        self, bus: AsyncBus, orders: asyncio.Queue[tuple[float, bytes]], writer: asyncio.StreamWriter
    ) -> None:
        """Carry out the requested transactions in order, until a request is malformed."""
        while True:
            received, body = await orders.get()
            try:
                number, messages = frames.parse_transfer(body)
            except frames.BadFrame:
                writer.close()
                return
            code, done = await _carry_out(bus, messages)
            sent = self._clock.now()
            if done is None:
                done = Transferred(received, received, ())
            answer = frames.Done(number, code, min(received, done.t0), done.t0, done.t1, max(sent, done.t1), done.reads)
            writer.write(frames.done(answer))
            await writer.drain()


async def _carry_out(bus: AsyncBus, messages: tuple[Message, ...]) -> tuple[int, Transferred | None]:
    try:
        check(messages)
        return 0, await bus.transfer(messages)
    except OSError as error:
        return error.errno or errno.EIO, None


async def _put(
    orders: asyncio.Queue[tuple[float, bytes]], order: tuple[float, bytes], worker: asyncio.Task[None]
) -> bool:
    """Queue a request, waiting for room; False when the worker has ended."""
    putting = asyncio.ensure_future(orders.put(order))
    await asyncio.wait({putting, worker}, return_when=asyncio.FIRST_COMPLETED)
    if worker.done():
        putting.cancel()
        return False
    return True


async def _check_loopback(where: str, host: str, port: int) -> None:
    if any(not ipaddress.ip_address(address).is_loopback for _, (address, *_) in await resolve(host, port)):
        remedy = "serve unix:/path or tcp://127.0.0.1:PORT and use ssh -L, or give --anyone on a private network"
        raise DeviceRefused(where, "every client of that address could write to all devices on the bus", remedy)


def _remove_stale_socket(path: Path) -> None:
    """Remove the socket file of a dead server; raises `DeviceRefused` for anything else at that path."""
    if not path.exists():
        return
    if not stat.S_ISSOCK(path.stat().st_mode):
        raise DeviceRefused(str(path), "the path exists and is not a socket", "choose another path")
    with socket.socket(socket.AF_UNIX) as caller, contextlib.suppress(ConnectionRefusedError):
        caller.setblocking(False)
        with contextlib.suppress(BlockingIOError):  # its queue of connections is full: it listens
            caller.connect(str(path))
        raise DeviceRefused(str(path), "another server listens there", "end that server, or choose another path")
    path.unlink(missing_ok=True)


def _private_socket(path: str) -> socket.socket:
    """A unix socket that only its owner can connect to; `chmod` or `chgrp` it to let others in."""
    sock = socket.socket(socket.AF_UNIX)
    try:
        sock.bind(path)
        Path(path).chmod(0o600)  # before listen(): no client can connect earlier
    except OSError:
        sock.close()
        raise
    return sock


async def _main(bus: str, where: str, anyone: bool) -> None:
    probe = await open_bus(bus)  # a problem with the bus shows at the start, not at the first client
    about = probe.about
    await probe.close()
    server = BusServer(open_bus, bus, SystemClock(), anyone=anyone)
    try:
        print_line(f"{bus} {about} on {await server.listen(where)}".replace("  ", " "))
        await until_stopped()
    finally:
        await server.close()


def main(arguments: list[str] | None = None) -> int:
    """Serve until interrupted; 2 when something in the arguments is wrong."""
    parser = argparse.ArgumentParser(
        prog="python -m hal.bus.i2c_server", description="Serves an I2C bus over a socket."
    )
    parser.add_argument("bus", help="/dev/i2c-N or adapter:NAME")
    parser.add_argument("where", help="unix:/path or tcp://host:port")
    parser.add_argument("--anyone", action="store_true", help="serve TCP beyond this computer, without authentication")
    options = parser.parse_args(arguments)
    try:
        asyncio.run(_main(options.bus, options.where, options.anyone))
    except HalError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
