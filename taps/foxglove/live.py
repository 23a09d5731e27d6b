"""`lumiloop foxglove`: a WebSocket server of the running daemon for the Foxglove app (ws://ADDRESS:8765).

The messages are those of the MCAP files. Static data (map, mount, state) are repeated to a new subscriber.
"""

from __future__ import annotations

import argparse
import asyncio
import threading
from typing import Final

import foxglove
from foxglove.websocket import ChannelView, Client, ServerListener

from daemon.config.endpoints import in_url, parse_endpoint
from daemon.publish.stream.client import Stream
from daemon.publish.stream.messages import NotTheStream
from daemon.system import console
from hal.run_server import run_until_stopped
from taps.ros import types
from taps.ros.messages import TOPICS, RosMessage
from taps.ros.stream_follower import forward

WANTED: Final = ("pose", "lights", "scan", "state", "loop", "faults", "statistics", "map")


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    try:
        host, port = parse_endpoint(args.listen)
        bridge = Bridge(host, port, args.settings.name)
    except ValueError as error:
        return console.fail(f"--listen: {error}", console.USAGE)
    except (OSError, RuntimeError) as error:
        return console.fail(f"cannot listen on {args.listen}: {error}; free it, or name another with --listen")
    console.say(f"ws://{in_url(host)}:{bridge.port}")
    try:
        stream = Stream(args.stream or args.settings.name, WANTED)
        asyncio.run(run_until_stopped(forward(stream, args.settings, bridge)))
    except NotTheStream as error:
        return console.fail(str(error))
    finally:
        bridge.close()
    return console.OK


class Bridge(ServerListener):
    """The live server with a channel for each topic."""

    def __init__(self, host: str, port: int, name: str) -> None:
        """Begin to serve; raises OSError or RuntimeError where the address cannot be used."""
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
