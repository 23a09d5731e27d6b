"""Client of the daemon's commands over Modbus UDP (docs/modbus.md): send a command and follow its outcome."""

from __future__ import annotations

import asyncio
import secrets
import struct
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from daemon.publish.modbus.holding import COMMAND, COMMAND_ADDRESS, CommandCode, Outcome, Request
from daemon.publish.port_owner import whose
from hal.blocking_calls import run_in_thread

MAP_ADDRESS: Final = COMMAND_ADDRESS + 10
STEPS: Final = (1e4, 1e4, 1e6)
"""Steps of the registers of a pose, per m and per rad."""
ATTEMPTS: Final = 4
ATTEMPT_S: Final = 0.3
POLL_S: Final = 0.1
LONGEST_S: Final = 60.0
"""A command is followed for this long."""


class CommandRefused(Exception):
    """A command that cannot be carried out; the text gives the cause and a remedy."""


class CommandClient(asyncio.DatagramProtocol):
    """Modbus requests over UDP and their responses; made by :func:`connect`."""

    def __init__(self) -> None:
        self._transport: asyncio.DatagramTransport | None = None
        self._transaction = 0
        self._pending: dict[int, asyncio.Future[bytes]] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """asyncio: the socket is open."""
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """asyncio: pass a response to its request."""
        pending = self._pending.get(int.from_bytes(data[:2], "big"))
        if pending is not None and not pending.done() and len(data) > 8:
            pending.set_result(data[7:])

    def error_received(self, exc: Exception) -> None:
        """asyncio: no server at the port; the request then times out."""

    async def request(self, body: bytes) -> bytes:
        """Send a request and return its response; a lost request is repeated, which has no second effect.

        Raises:
            CommandRefused: no response, or a Modbus exception.
        """
        assert self._transport is not None
        self._transaction = self._transaction % 0xFFFF + 1
        transaction = self._transaction
        response = self._pending[transaction] = asyncio.get_running_loop().create_future()
        try:
            for _ in range(ATTEMPTS):
                self._transport.sendto(struct.pack(">HHHB", transaction, 0, len(body) + 1, 1) + body)
                done, _ = await asyncio.wait([response], timeout=ATTEMPT_S)
                if done:
                    break
            else:
                raise CommandRefused("the Modbus server of the daemon does not answer; check `modbus.port`")
        finally:
            del self._pending[transaction]
        received: bytes = response.result()
        if received[0] & 0x80:
            raise CommandRefused(
                f"the daemon accepts no commands (Modbus exception {received[1]}); set `modbus.write = true`"
            )
        return received

    async def next_number(self) -> int:
        """A random number for a new command, other than the present one; two clients rarely choose the same."""
        before = await self.request(struct.pack(">BHH", 3, COMMAND_ADDRESS, 1))
        return (int.from_bytes(before[2:4], "big") + secrets.randbelow(0xFFFE)) % 0xFFFF + 1

    async def outcome(self, written: bytes, map_id: bytes = b"") -> tuple[bool, bool, Outcome]:
        """Whether the present command is still ours, whether it has ended, and its outcome.

        ``written``, ``map_id``: the registers as this client wrote them. Another client may have used the same number,
        or have written another map in between.
        """
        registers = await self.request(struct.pack(">BHH", 3, COMMAND_ADDRESS, COMMAND.words))
        number = int.from_bytes(written[:2], "big")
        acknowledged, result = struct.unpack(">HH", registers[2 + 16 : 2 + 20])
        try:
            outcome = Outcome(result)
        except ValueError:
            outcome = Outcome.UNKNOWN
        ours = registers[2:].startswith(written) and registers.endswith(map_id)
        return ours, acknowledged == number and outcome is not Outcome.RUNNING, outcome

    async def wait_for_end(self, written: bytes, map_id: bytes = b"", longest_s: float = LONGEST_S) -> str:
        """Poll until the command ends: its outcome in lower case, ``replaced``, or ``no result received`` in that time.

        Raises:
            CommandRefused: the server does not answer.
        """
        loop = asyncio.get_running_loop()
        end = loop.time() + longest_s
        while loop.time() < end:
            ours, ended, result = await self.outcome(written, map_id)
            if not ours:
                return "replaced"
            if ended:
                return result.name.lower()
            await asyncio.sleep(POLL_S)
        return "no result received"

    async def require_owner(self, daemon: str | Path) -> None:
        """Check that the server belongs to the daemon with this name or stream; passes where that cannot be determined.

        Raises:
            CommandRefused: the port belongs to another process.
        """
        assert self._transport is not None
        host, port = self._transport.get_extra_info("peername")[:2]
        found = await run_in_thread(partial(whose, daemon, host, port), "whose")
        if found.another:
            raise CommandRefused(
                f"{host}:{port} belongs to {found}, not to the requested daemon (process {found.meant}); name "
                "its configuration with --config, or give one of them another `modbus.port`"
            )

    def close(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()


async def connect(host: str, port: int) -> CommandClient:
    """Open a socket to the daemon's Modbus server; raises `CommandRefused` where the address cannot be used."""
    try:
        _, client = await asyncio.get_running_loop().create_datagram_endpoint(CommandClient, remote_addr=(host, port))
    except OSError as error:
        raise CommandRefused(f"{host}:{port}: {error.strerror or error}") from None
    return client


async def give(host: str, port: int, request: Request, daemon: str | None, longest_s: float = LONGEST_S) -> str:
    """Send a command and wait for its end; returns the outcome as :meth:`CommandClient.wait_for_end`.

    ``daemon``: name of the one that must own the port; None: any. The number of ``request`` is chosen here.

    Raises:
        CommandRefused: the command cannot be sent.
    """
    client = await connect(host, port)
    try:
        if daemon is not None:
            await client.require_owner(daemon)
        number = await client.next_number()
        target = b""
        if request.code is CommandCode.SWITCH_MAP:
            target = struct.pack(">I", request.map_id)
            await client.request(struct.pack(">BHHB", 16, MAP_ADDRESS, 2, 4) + target)
        written = struct.pack(">HH", number, request.code)
        if request.code is CommandCode.SET_POSE:
            written += pose_registers(request.pose)
        await client.request(struct.pack(">BHHB", 16, COMMAND_ADDRESS, len(written) // 2, len(written)) + written)
        return await client.wait_for_end(written, target, longest_s)
    finally:
        client.close()
        await asyncio.sleep(0)  # the loop closes the socket one turn later


def pose_registers(pose: tuple[float, float, float]) -> bytes:
    """A pose (m, m, rad) in the registers' steps; raises `CommandRefused` where they cannot hold it."""
    try:
        return struct.pack(">iii", *(round(scale * value) for scale, value in zip(STEPS, pose, strict=True)))
    except (struct.error, OverflowError, ValueError):
        raise CommandRefused("the pose is out of range; registers hold poses within 200000 m and 2000 rad") from None


async def switch_map(name: str, host: str, port: int, map_id: int) -> str:
    """Switch the daemon of that name to another stored map; otherwise as :func:`give`."""
    return await give(host, port, Request(0, CommandCode.SWITCH_MAP, (0.0, 0.0, 0.0), map_id), name)
