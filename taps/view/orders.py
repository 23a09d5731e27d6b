"""Orders of the page to the daemon: written over Modbus UDP as any client may (docs/modbus.md), the last one wins.

Everybody who watches is told what was ordered, by which viewer, and what became of it.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import struct
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, cast

from daemon.publish.modbus.holding import COMMAND, COMMAND_ADDRESS, CommandCode, Outcome
from daemon.publish.port_owner import whose
from daemon.publish.stream.client import Stream
from hal.blocking_calls import run_in_thread

MAP_ADDRESS: Final = COMMAND_ADDRESS + 10
TRIES: Final = 4
TRY_S: Final = 0.3
ASK_AGAIN_S: Final = 0.1
LONGEST_S: Final = 60.0
"""How long an order is followed."""
FARTHEST_M: Final = 100_000.0

NAMES: Final = {
    "save_map": CommandCode.SAVE_MAP,
    "relocalise": CommandCode.RELOCALISE,
    "set_pose": CommandCode.SET_POSE,
    "dump_recorder": CommandCode.DUMP_RECORDER,
    "pause": CommandCode.PAUSE,
    "resume": CommandCode.RESUME,
}
"""What a page may order."""

Tell = Callable[[dict[str, object]], None]


class OrderRefused(Exception):
    """An order that cannot be given; the text says why and what to do."""


class Wire(asyncio.DatagramProtocol):
    """Modbus requests and their answers."""

    def __init__(self) -> None:
        self._transport: asyncio.DatagramTransport | None = None
        self._number = 0
        self._waiting: dict[int, asyncio.Future[bytes]] = {}

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """It can be used."""
        self._transport = cast(asyncio.DatagramTransport, transport)

    def datagram_received(self, data: bytes, addr: tuple[str | Any, int]) -> None:
        """An answer."""
        waiting = self._waiting.get(int.from_bytes(data[:2], "big"))
        if waiting is not None and not waiting.done() and len(data) > 8:
            waiting.set_result(data[7:])

    def error_received(self, exc: Exception) -> None:
        """Nobody is there: the time runs out, and that is told."""

    async def ask(self, body: bytes) -> bytes:
        """The answer to a request; a lost one is repeated, which does nothing twice.

        Raises:
            OrderRefused: no answer, or none that helps.
        """
        assert self._transport is not None
        self._number = self._number % 0xFFFF + 1
        number = self._number
        answer = self._waiting[number] = asyncio.get_running_loop().create_future()
        try:
            for _ in range(TRIES):
                self._transport.sendto(struct.pack(">HHHB", number, 0, len(body) + 1, 1) + body)
                done, _ = await asyncio.wait([answer], timeout=TRY_S)
                if done:
                    break
            else:
                raise OrderRefused("the daemon's Modbus server does not answer: is `modbus.port` as in its file?")
        finally:
            del self._waiting[number]
        told: bytes = answer.result()
        if told[0] & 0x80:
            raise OrderRefused(f"the daemon takes no orders (Modbus exception {told[1]}): set `modbus.write = true`")
        return told

    async def next_number(self) -> int:
        """A number that starts a command: not the one in force, and not what another client would take next, too."""
        before = await self.ask(struct.pack(">BHH", 3, COMMAND_ADDRESS, 1))
        return (int.from_bytes(before[2:4], "big") + secrets.randbelow(0xFFFE)) % 0xFFFF + 1

    async def outcome(self, ours: bytes, map_id: bytes = b"") -> tuple[bool, bool, Outcome]:
        """Whether the order in force is still ours, whether it has ended, and how.

        ``ours``, ``map_id``: the registers as they were written; another client may have taken the same number, or have
        named another map in between.
        """
        told = await self.ask(struct.pack(">BHH", 3, COMMAND_ADDRESS, COMMAND.words))
        number = int.from_bytes(ours[:2], "big")
        acknowledged, result = struct.unpack(">HH", told[2 + 16 : 2 + 20])
        try:
            outcome = Outcome(result)
        except ValueError:
            outcome = Outcome.UNKNOWN
        mine = told[2:].startswith(ours) and told.endswith(map_id)
        return mine, acknowledged == number and outcome is not Outcome.RUNNING, outcome

    async def only(self, meant: str | Path) -> None:
        """Whether it is that daemon, by name or by stream, who would obey; what cannot be seen is taken for it.

        Raises:
            OrderRefused: it is another one's port.
        """
        assert self._transport is not None
        host, port = self._transport.get_extra_info("peername")[:2]
        found = await run_in_thread(partial(whose, meant, host, port), "whose")
        if found.another:
            raise OrderRefused(
                f"{host}:{port} is answered by {found}, not by the daemon that is meant (process {found.meant}): name "
                "its configuration with --config, or give one of them another `modbus.port`"
            )

    def close(self) -> None:
        """Close the socket."""
        if self._transport is not None:
            self._transport.close()


class Orders:
    """Gives orders, and follows the latest.

    Args:
        host, port: of the daemon's Modbus server. tell: told of every order and of its end, for all viewers.
        stream: of the daemon that is shown, who alone is meant.
    """

    def __init__(self, host: str, port: int, tell: Tell, stream: Stream | None = None) -> None:
        self._where, self._tell, self._stream = (host, port), tell, stream
        self._wire: Wire | None = None
        self._following: asyncio.Task[None] | None = None
        self._latest: dict[str, object] = {}
        self._giving = asyncio.Lock()

    async def give(self, viewer: int, asked: Mapping[str, Any]) -> None:
        """Give an order of a viewer.

        Raises:
            OrderRefused: it cannot be given.
        """
        name, pose = str(asked.get("order")), _pose_of(asked)
        if name not in NAMES:
            raise OrderRefused(f"there is no order {name[:40]!r}")
        if not self._where[1]:
            raise OrderRefused("the configuration switches Modbus off (`modbus.port` is 0), which carries orders")
        async with self._giving:
            await self._give(viewer, name, pose)

    async def _give(self, viewer: int, name: str, pose: tuple[float, float, float]) -> None:
        wire = await self._ready()
        if self._stream is not None:
            await wire.only(self._stream.path)
        number = await wire.next_number()
        x, y, yaw = round(pose[0] * 1e4), round(pose[1] * 1e4), round(pose[2] * 1e6)
        words = struct.pack(">HHiii", number, NAMES[name], x, y, yaw)
        await wire.ask(struct.pack(">BHHB", 16, COMMAND_ADDRESS, 8, 16) + words)
        if self._following is not None and not self._following.done():
            self._following.cancel()
            self._tell({**self._latest, "outcome": "replaced", "by": viewer})
        self._latest = {"order": name, "pose": pose if name == "set_pose" else None, "viewer": viewer, "number": number}
        self._tell({**self._latest, "outcome": "running"})
        self._following = asyncio.create_task(self._follow(wire, words, dict(self._latest)))

    async def close(self) -> None:
        """Stop following."""
        if self._following is not None:
            self._following.cancel()
            await asyncio.gather(self._following, return_exceptions=True)
        if self._wire is not None:
            self._wire.close()
            await asyncio.sleep(0)  # the loop closes the socket a turn later

    async def _ready(self) -> Wire:
        if self._wire is None:
            self._wire = await _wired(*self._where)
        return self._wire

    async def _follow(self, wire: Wire, ours: bytes, told: dict[str, object]) -> None:
        """Until it has ended."""
        outcome = "no end seen"
        end = asyncio.get_running_loop().time() + LONGEST_S
        while asyncio.get_running_loop().time() < end:
            try:
                mine, ended, result = await wire.outcome(ours)
            except OrderRefused as error:
                outcome = str(error)
                break
            if not mine:
                outcome = "replaced"  # by a client that is none of ours
                break
            if ended:
                outcome = result.name.lower()
                break
            await asyncio.sleep(ASK_AGAIN_S)
        self._tell({**told, "outcome": outcome})


async def _wired(host: str, port: int) -> Wire:
    try:
        _, wire = await asyncio.get_running_loop().create_datagram_endpoint(Wire, remote_addr=(host, port))
    except OSError as error:
        raise OrderRefused(f"{host}:{port}: {error.strerror or error}") from None
    return wire


async def switch_map(name: str, host: str, port: int, map_id: int) -> str:
    """Have the daemon of that name go on in another stored map; how that ended, in a word.

    Raises:
        OrderRefused: it cannot be ordered.
    """
    wire = await _wired(host, port)
    try:
        await wire.only(name)
        number = await wire.next_number()
        named = struct.pack(">I", map_id)
        await wire.ask(struct.pack(">BHHB", 16, MAP_ADDRESS, 2, 4) + named)
        ours = struct.pack(">HH", number, CommandCode.SWITCH_MAP)
        await wire.ask(struct.pack(">BHHB", 16, COMMAND_ADDRESS, 2, 4) + ours)
        end = asyncio.get_running_loop().time() + LONGEST_S
        while asyncio.get_running_loop().time() < end:
            mine, ended, result = await wire.outcome(ours, named)
            if not mine:
                return "replaced"
            if ended:
                return result.name.lower()
            await asyncio.sleep(ASK_AGAIN_S)
        return "no end seen"
    finally:
        wire.close()
        await asyncio.sleep(0)  # the loop closes the socket a turn later


def _pose_of(asked: Mapping[str, Any]) -> tuple[float, float, float]:
    """The pose that is asked for; the origin where none is wanted.

    Raises:
        OrderRefused: there is none, or none that can be.
    """
    if asked.get("order") != "set_pose":
        return 0.0, 0.0, 0.0
    told = asked.get("pose")
    if not isinstance(told, list) or len(told) != 3 or not all(_is_number(value) for value in told):
        raise OrderRefused("set_pose wants a pose: x, y in m, yaw in rad")
    x, y, yaw = (float(value) for value in told)
    if max(abs(x), abs(y)) > FARTHEST_M:
        raise OrderRefused(f"a pose more than {FARTHEST_M:.0f} m away")
    return x, y, math.remainder(yaw, 2.0 * math.pi)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
