"""`lumiloop foxglove`: a WebSocket server of the running daemon for the Foxglove app (ws://ADDRESS:8765).

The messages are those of the MCAP files. Clients connect through `taps.foxglove.gate`. Static data (map, mount, state)
are repeated to a new subscriber.
"""

from __future__ import annotations

import argparse
import asyncio
import threading
from collections.abc import Coroutine, Sequence
from typing import Any, Final

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from daemon.config.endpoints import in_url, parse_endpoint
from daemon.publish.stream.client import Stream
from daemon.publish.stream.messages import NotTheStream
from daemon.system import console
from hal.run_server import run_until_stopped
from taps.access_guard import Guard
from taps.foxglove.gate import LONGEST_HEAD, Gate, random_loopback
from taps.ros import types
from taps.ros.messages import TOPICS, RosMessage
from taps.ros.stream_follower import forward

WANTED: Final = ("pose", "lights", "scan", "state", "loop", "faults", "statistics", "map")


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    try:
        host, port = parse_endpoint(args.listen)
    except ValueError as error:
        return console.fail(f"--listen: {error}", console.USAGE)
    bridge = Bridge(random_loopback(), 0, args.settings.name)
    stream = Stream(args.stream or args.settings.name, WANTED)
    try:
        asyncio.run(serve(bridge, (host, port), args.origin, forward(stream, args.settings, bridge)))
    except NotTheStream as error:
        return console.fail(str(error))
    except OSError as error:
        why = error.strerror or error
        return console.fail(f"cannot listen on {args.listen}: {why}; free the address, or name another with --listen")
    finally:
        bridge.close()
    return console.OK


async def serve(
    bridge: Bridge, listen: tuple[str, int], origins: Sequence[str], forwarding: Coroutine[Any, Any, None]
) -> None:
    """Accept clients on an address, and send them messages until stopped.

    Raises:
        OSError: the address cannot be used. NotTheStream: by ``forwarding``.
    """
    gate = Gate(Guard(bind=listen[0]), origins, (bridge.host, bridge.port))
    try:
        server = await asyncio.start_server(gate, *listen, limit=LONGEST_HEAD)
    except OSError:
        forwarding.close()
        raise
    console.say(f"ws://{in_url(listen[0])}:{server.sockets[0].getsockname()[1]}")
    try:
        await run_until_stopped(forwarding)
    finally:
        server.close()
        await gate.close()


class Bridge(ServerListener):
    """The live server with a channel for each topic."""

    def __init__(self, host: str, port: int, name: str) -> None:
        """Begin to serve; raises OSError or RuntimeError where the address cannot be used."""
        self.host = host
        self._context = foxglove.Context()
        self._latest: dict[str, RosMessage] = {}
        self._repeat: set[str] = set()
        self._lock = threading.Lock()
        self._channels = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=about.kind, encoding="ros2msg", data=types.definition(about.kind).encode()),
                message_encoding="cdr",
                context=self._context,
            )
            for topic, about in TOPICS.items()
            if topic != "/lumiloop/raw"
        }
        self._server = foxglove.start_server(
            name=f"lumiloop {name}", host=host, port=port, server_listener=self, context=self._context
        )
        self.port = int(self._server.port)

    def send(self, out: RosMessage) -> None:
        """Send one message to the subscribers; first repeat the latched ones that new subscribers lack."""
        if self._repeat:
            with self._lock:
                repeat, self._repeat = self._repeat, set()
            for topic in repeat & set(self._latest):
                self._channels[topic].log(self._latest[topic].data, log_time=self._latest[topic].t_ns)
        channel = self._channels.get(out.topic)
        if channel is None:
            return
        if TOPICS[out.topic].latched:
            self._latest[out.topic] = out
        if channel.has_sinks():
            channel.log(out.data, log_time=out.t_ns)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """Repeat the topic's last message for a new subscriber; called by the server's thread."""
        with self._lock:
            self._repeat.add(channel.topic)

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()
