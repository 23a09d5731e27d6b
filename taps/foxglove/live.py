"""`lumiloop foxglove`: a running daemon, live, for the Foxglove app: open a connection to ws://ADDRESS:8765.

The messages are those of the MCAP files. What stands still (map, mount, state) is said again to whoever subscribes.
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
from taps.ros.messages import TOPICS, Out
from taps.ros.stream_follower import follow

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
        asyncio.run(run_until_stopped(follow(stream, args.settings, bridge)))
    except NotTheStream as error:
        return console.fail(str(error))
    finally:
        bridge.close()
    return console.OK


class Bridge(ServerListener):
    """The live server, and a channel for each topic."""

    def __init__(self, host: str, port: int, name: str) -> None:
        """Begin to serve; raises OSError or RuntimeError where it cannot be listened."""
        self._context = foxglove.Context()
        self._latest: dict[str, Out] = {}
        self._again: set[str] = set()
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

    def send(self, out: Out) -> None:
        """One message to whoever has subscribed; before it what those who are new have missed."""
        if self._again:
            with self._lock:
                again, self._again = self._again, set()
            for topic in again & set(self._latest):
                self._channels[topic].log(self._latest[topic].data, log_time=self._latest[topic].t_ns)
        channel = self._channels.get(out.topic)
        if channel is None:
            return
        if TOPICS[out.topic].latched:
            self._latest[out.topic] = out
        if channel.has_sinks():
            channel.log(out.data, log_time=out.t_ns)

    def on_subscribe(self, client: Client, channel: ChannelView) -> None:
        """A client wants a topic: what was said of it last will be said again; called by the server's thread."""
        with self._lock:
            self._again.add(channel.topic)

    def close(self) -> None:
        """Stop serving."""
        self._server.stop()
