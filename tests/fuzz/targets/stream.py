"""What the taps of the local stream ask for."""

import asyncio
import gc
import random
import time
import weakref
from collections.abc import Awaitable, Callable
from pathlib import Path

import msgspec

from daemon.maps.tiles import MapTiles
from daemon.publish.stream.server import TOPICS, Client, StreamServer, framed
from daemon.publish.stream.session import BUFFER_BYTES
from hal.clock import VirtualLoop
from hal.net.fair_share import Share
from tests.daemon.publish.modbus.test_registers import snapshot

MEGABYTES = 10
TILES, TILE_SIZE = 400, 600
"""Of the map: as many as of a large hall."""
TURN_S = 0.04
"""Processor time of one turn of the loop; a slow shared machine took 21 ms for one. The garbage collector's is not
counted."""


def seeds() -> list[bytes]:
    asked = [{"want": [topic]} for topic in TOPICS]
    asked += [{"want": sorted(TOPICS)}, {"want": []}, {"want": ["none"]}, {"want": 3}, {"wish": {}}, {"want": [1]}]
    anew = framed({"want": []}) + framed({"want": ["map"]})
    together = [b"".join(framed(one) for one in asked), framed({"want": ["pose"] * 400}), anew * 600]
    return [*(framed(one) for one in asked), *together]


def mend(data: bytes) -> bytes:
    """The length that there is."""
    return data if len(data) < 4 else (len(data) - 4).to_bytes(4, "little") + data[4:]


class Wire(asyncio.Transport):
    """A connection whose other end takes what has come whenever the test looks, and nothing before."""

    def __init__(self) -> None:
        super().__init__()
        self.sent, self.closed, self.reading = bytearray(), False, True
        self._client: Client | None = None
        self._full = False

    def plug(self, client: Client) -> None:
        self._client = client
        client.connection_made(self)

    def is_closing(self) -> bool:
        return self.closed

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.sent += data
        if len(self.sent) > BUFFER_BYTES and not self._full and self._client is not None:
            self._full = True
            self._client.pause_writing()

    def taken(self) -> list[dict[str, object]]:
        """All that has come, as far as the other end is told more when it takes this."""
        found = []
        while self.sent:
            data, at = bytes(self.sent), 0
            self.sent.clear()
            while at < len(data):
                size = int.from_bytes(data[at : at + 4], "little")
                found.append(msgspec.msgpack.decode(data[at + 4 : at + 4 + size], type=dict[str, object]))
                at += 4 + size
            if self._full and self._client is not None:
                self._full = False
                self._client.resume_writing()
        return found

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        assert high == BUFFER_BYTES

    def pause_reading(self) -> None:
        self.reading = False

    def resume_reading(self) -> None:
        self.reading = True

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = True


async def quick(turn: Awaitable[None]) -> None:
    """One turn of the loop, which is to be short."""
    gc.disable()
    try:
        begun = time.thread_time()
        await turn
        took = time.thread_time() - begun
    finally:
        gc.enable()
    assert took < TURN_S, f"the loop stands still for {1e3 * took:.0f} ms"


def feeder() -> Callable[[bytes], None]:
    loop = VirtualLoop()
    server = StreamServer(Path("/nowhere"), "robot", lambda reason: ("meaning", "remedy"))
    server.share = Share(loop.time)
    tiles = server.tiles = MapTiles(lambda: None, server.on_tiles)
    chance = random.Random(1)
    tiles.tiles = {(column, 0): (1, chance.randbytes(TILE_SIZE)) for column in range(TILES)}
    shown = snapshot()

    async def receive(client: Client, piece: bytes) -> None:
        client.data_received(piece)

    async def talk(data: bytes) -> None:
        client, wire = Client(server), Wire()
        wire.plug(client)
        assert wire.taken()[0]["topic"] == "hello"
        cut = len(data) // 2
        for piece in (data[:cut], data[cut:]):
            if not wire.closed:
                await quick(receive(client, piece))
            while not (wire.reading or wire.closed):
                assert {one["topic"] for one in wire.taken()} <= {"error", *TOPICS}
                await quick(asyncio.sleep(0.01))
        assert client.wants <= set(TOPICS)
        assert {one["topic"] for one in wire.taken()} <= {"error", *TOPICS}
        server.publish(shown)
        assert all(one["topic"] in client.wants for one in wire.taken())
        client.connection_lost(None)
        assert not server.clients

    async def honest() -> None:
        client, wire = Client(server), Wire()
        wire.plug(client)
        client.data_received(framed({"want": ["pose"]}))
        server.publish(shown)
        assert [one["topic"] for one in wire.taken()] == ["hello", "pose"]
        client.connection_lost(None)

    def feed(data: bytes) -> None:
        loop.run_until_complete(talk(data))
        loop.run_until_complete(honest())

    weakref.finalize(feed, loop.close)
    return feed
