"""Operator commands of the web page: sent to the daemon over Modbus UDP; the latest command wins.

Every viewer receives each command, the number of the viewer that gave it, and its outcome.
"""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any, Final

from daemon.publish.modbus.command_client import CommandClient, CommandRefused, connect
from daemon.publish.modbus.holding import COMMAND_ADDRESS, CommandCode
from daemon.publish.stream.client import Stream

FARTHEST_M: Final = 100_000.0

NAMES: Final = {
    "save_map": CommandCode.SAVE_MAP,
    "relocalise": CommandCode.RELOCALISE,
    "set_pose": CommandCode.SET_POSE,
    "dump_recorder": CommandCode.DUMP_RECORDER,
    "pause": CommandCode.PAUSE,
    "resume": CommandCode.RESUME,
}
"""Commands that a page may give, by name."""

Notify = Callable[[dict[str, object]], None]


class Orders:
    """Sends the commands of viewers, and follows the latest.

    Args:
        host, port: of the daemon's Modbus server. notify: receives every command and its outcome, for all viewers.
        stream: of the daemon that is shown; commands go to no other daemon.
    """

    def __init__(self, host: str, port: int, notify: Notify, stream: Stream | None = None) -> None:
        self._address, self._notify, self._stream = (host, port), notify, stream
        self._client: CommandClient | None = None
        self._following: asyncio.Task[None] | None = None
        self._latest: dict[str, object] = {}
        self._sending = asyncio.Lock()

    async def give(self, viewer: int, message: Mapping[str, Any]) -> None:
        """Carry out the command in a viewer's message.

        Raises:
            CommandRefused: unknown, malformed, or not accepted by the daemon.
        """
        name, pose = str(message.get("order")), _pose_of(message)
        if name not in NAMES:
            raise CommandRefused(f"unknown command {name[:40]!r}")
        if not self._address[1]:
            raise CommandRefused("commands need Modbus, which is disabled (`modbus.port` is 0)")
        async with self._sending:
            await self._send(viewer, name, pose)

    async def _send(self, viewer: int, name: str, pose: tuple[float, float, float]) -> None:
        if self._client is None:
            self._client = await connect(*self._address)
        client = self._client
        if self._stream is not None:
            await client.require_owner(self._stream.path)
        number = await client.next_number()
        x, y, yaw = round(pose[0] * 1e4), round(pose[1] * 1e4), round(pose[2] * 1e6)
        registers = struct.pack(">HHiii", number, NAMES[name], x, y, yaw)
        await client.request(struct.pack(">BHHB", 16, COMMAND_ADDRESS, 8, 16) + registers)
        if self._following is not None and not self._following.done():
            self._following.cancel()
            self._notify({**self._latest, "outcome": "replaced", "by": viewer})
        self._latest = {"order": name, "pose": pose if name == "set_pose" else None, "viewer": viewer, "number": number}
        self._notify({**self._latest, "outcome": "running"})
        self._following = asyncio.create_task(self._follow(client, registers, dict(self._latest)))

    async def close(self) -> None:
        """Stop following, and close the socket."""
        if self._following is not None:
            self._following.cancel()
            await asyncio.gather(self._following, return_exceptions=True)
        if self._client is not None:
            self._client.close()
            await asyncio.sleep(0)  # the loop closes the socket one turn later

    async def _follow(self, client: CommandClient, registers: bytes, order: dict[str, object]) -> None:
        """Wait for the end of a command and report its outcome."""
        try:
            outcome = await client.wait_for_end(registers)
        except CommandRefused as error:
            outcome = str(error)
        self._notify({**order, "outcome": outcome})


def _pose_of(message: Mapping[str, Any]) -> tuple[float, float, float]:
    """The pose in a ``set_pose`` message (m, m, rad); the origin for any other command.

    Raises:
        CommandRefused: no pose, or one out of range.
    """
    if message.get("order") != "set_pose":
        return 0.0, 0.0, 0.0
    values = message.get("pose")
    if not isinstance(values, list) or len(values) != 3 or not all(_is_number(value) for value in values):
        raise CommandRefused("set_pose needs x and y in m, and yaw in rad")
    x, y, yaw = (float(value) for value in values)
    if max(abs(x), abs(y)) > FARTHEST_M:
        raise CommandRefused(f"the pose is more than {FARTHEST_M:.0f} m away")
    return x, y, math.remainder(yaw, 2.0 * math.pi)


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)
