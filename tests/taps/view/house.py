"""A stream, perhaps a Modbus server, and a page's server in one loop, for tests over real loopback sockets."""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
from aiohttp import ClientSession, ClientWebSocketResponse, web

from daemon.publish.stream.client import Stream
from daemon.publish.stream.server import StreamServer
from daemon.snapshot import CycleTiming, LightFix, LightLink, LightPicture, LinkUse, Snapshot, State, Trust
from taps.access_guard import Guard
from taps.view.page_hello import Scene
from taps.view.replay_file import ReplayFile
from taps.view.server import TOPICS, View
from tests.daemon.publish.stream.test_server import until

TOKEN = "a-token-of-more-than-sixteen-letters"
PATIENCE_S = 5.0
LIGHT = LightPicture(
    LightFix.GOOD, 2, 1.0, (1.0, 2.0, 3.0), (0.01, 0.02, 0.03), 0.1, 3.0, 7, 0,
    (LightLink(73, 10, LinkUse.ACCEPTED, 8e-7, -0.01), LightLink(65, None, LinkUse.TWIN, 3e-7)),
)  # fmt: skip


def snapshot(seq: int, **other: Any) -> Snapshot:
    """As a daemon would publish it, 25 ms after the one before."""
    t = 100.0 + 0.025 * seq
    told: dict[str, Any] = {
        "pose": (0.01 * seq, 0.0, 0.1), "covariance": (1e-4, 0.0, 4e-4, 0.0, 0.0, 1e-4), "map_id": 7, "light": LIGHT,
        "links": 2, "cycle_us": 1500, "trust": Trust(horizontal_m=0.1, gap=1.0), "velocity": (0.4, 0.0, 0.0),
        "pulse": CycleTiming(cycle=(1500, 2500, 4000), late=(100, 300, 900), stages=((100, 200, 300), None)),
        "scan_rate": 40.0, "known": (True, True, True), "lidar_ok": True, **other,
    }  # fmt: skip
    return Snapshot(seq, t, t + 0.002, 1.7e9 + t + 0.002, told.pop("state", State.TRACKING), 0, **told)


@dataclass
class House:
    """What runs. `say` opens a page's WebSocket and says its first words."""

    stream: StreamServer
    view: View
    session: ClientSession
    address: str

    @contextlib.asynccontextmanager
    async def page(self, token: str | None = None, **headers: str) -> AsyncIterator[Page]:
        async with self.session.ws_connect(f"{self.address}/ws", headers=headers) as socket:
            await socket.send_json({"page": self.view.page, "token": token})
            yield Page(socket)


class Page:
    """What a browser is told."""

    def __init__(self, socket: ClientWebSocketResponse) -> None:
        self.socket = socket
        self.words: list[dict[str, Any]] = []
        self.frames: list[tuple[str, Any]] = []

    async def read(self) -> bool:
        """One message more; whether there was one."""
        message = await self.socket.receive(PATIENCE_S)
        if message.type is web.WSMsgType.TEXT:
            self.words.append(json.loads(message.data))
        elif message.type is web.WSMsgType.BINARY:
            self.frames += [(frame["topic"], frame["data"]) for frame in msgspec.msgpack.decode(message.data)]
        else:
            return False
        return True

    async def welcome(self) -> dict[str, Any]:
        assert await self.read()
        return self.words[-1]

    async def until(self, topic: str, right: Callable[[Any], bool] = lambda _: True) -> Any:
        """The first frame of a topic that is right; what came before it is not looked at again."""
        while True:
            while self.frames:
                told, data = self.frames.pop(0)
                if told == topic and right(data):
                    return data
            assert await self.read(), self.words


@contextlib.asynccontextmanager
async def serving(
    folder: Path,
    guard: Guard | None = None,
    film: ReplayFile | None = None,
    modbus: int = 0,
    scene: Scene | None = None,
    again: Callable[[], Scene] | None = None,
) -> AsyncIterator[House]:
    path = folder / "stream"
    stream = StreamServer(path, "agv", lambda reason: ("is received as expected again", ""))
    task = asyncio.create_task(stream.run())
    source = None if film is not None else Stream(path, TOPICS)
    view = View(guard or Guard("127.0.0.1"), scene or Scene("agv"), source, film, ("127.0.0.1", modbus), again)
    await until(path.is_socket)
    runner = view.runner(0.1)
    await runner.setup()
    await web.TCPSite(runner, "127.0.0.1", 0).start()
    if film is None:
        await until(lambda: stream.wanted("pose"))
    try:
        async with ClientSession() as session:
            yield House(stream, view, session, f"http://127.0.0.1:{runner.addresses[0][1]}")
    finally:
        await runner.cleanup()
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
