"""What the taps of the local stream ask for."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path

import msgspec

from daemon.publish.stream import BUFFER_BYTES, TOPICS, Client, StreamServer, framed
from tests.daemon.publish.test_registers import snapshot

MEGABYTES = 10
PARSERS = ("daemon/publish/stream.py",)


def seeds() -> list[bytes]:
    asked = [{"want": [topic]} for topic in TOPICS]
    asked += [{"want": sorted(TOPICS)}, {"want": []}, {"want": ["none"]}, {"want": 3}, {"wish": {}}, {"want": [1]}]
    return [*(framed(one) for one in asked), b"".join(framed(one) for one in asked), framed({"want": ["pose"] * 400})]


def mend(data: bytes) -> bytes:
    """The length that there is."""
    return data if len(data) < 4 else (len(data) - 4).to_bytes(4, "little") + data[4:]


class Wire(asyncio.Transport):
    """A connection whose other end takes whatever comes, or nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.sent, self.closed = bytearray(), False

    def write(self, data: bytes | bytearray | memoryview) -> None:
        self.sent += data

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        assert high == BUFFER_BYTES

    def close(self) -> None:
        self.closed = True

    def abort(self) -> None:
        self.closed = True


def feeder() -> Callable[[bytes], None]:
    server = StreamServer(Path("/nowhere"), "robot", lambda reason: ("meaning", "remedy"))
    taken = snapshot()

    def messages(wire: Wire) -> list[dict[str, object]]:
        found, data = [], bytes(wire.sent)
        while data:
            size = int.from_bytes(data[:4], "little")
            found.append(msgspec.msgpack.decode(data[4 : 4 + size], type=dict[str, object]))
            data = data[4 + size :]
        wire.sent.clear()
        return found

    def talk(data: bytes) -> None:
        client, wire = Client(server), Wire()
        client.connection_made(wire)
        assert messages(wire)[0]["topic"] == "hello"
        cut = len(data) // 2
        for piece in (data[:cut], data[cut:]):
            if not wire.closed:
                client.data_received(piece)
        assert client.wants <= set(TOPICS)
        assert {one["topic"] for one in messages(wire)} <= {"error", *TOPICS}
        server.publish(taken)
        assert all(one["topic"] in client.wants for one in messages(wire))
        client.connection_lost(None)
        assert not server.clients

    def feed(data: bytes) -> None:
        talk(data)
        honest, wire = Client(server), Wire()
        honest.connection_made(wire)
        honest.data_received(framed({"want": ["pose"]}))
        server.publish(taken)
        assert [one["topic"] for one in messages(wire)] == ["hello", "pose"]
        honest.connection_lost(None)

    return feed
