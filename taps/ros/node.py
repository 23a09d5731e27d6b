"""`lumiloop ros2`: the running daemon as a ROS 2 node over Zenoh (rmw_zenoh), without a ROS installation.

The messages are those of the MCAP files. Static data (map, mount, state) are kept for late subscribers, as transient
local durability requires.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import time
from typing import Final

import zenoh

from daemon.publish.stream.client import Stream
from daemon.publish.stream.messages import NotTheStream
from daemon.system import console
from hal.run_server import run_until_stopped
from taps.ros import rmw_zenoh, types
from taps.ros.messages import TOPICS, RosMessage
from taps.ros.stream_follower import forward
from taps.zenoh_session import BadEndpoint, list_tokens, open_session, undeclare, watch_router

WANTED: Final = ("pose", "lights", "scan", "state", "loop", "faults", "statistics", "map")
NAME: Final = "lumiloop"
HEARTBEAT_S: Final = 0.5
"""A subscriber that missed the last message of a latched topic detects it within this time, as in rmw_zenoh."""


class NameTaken(Exception):
    """Another node has this name; the text gives a remedy."""


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    try:
        namespace = rmw_zenoh.namespace_of(args.namespace)
        stream = Stream(args.stream or args.settings.name, WANTED)
        asyncio.run(run_until_stopped(serve(args, namespace, stream)))
    except ValueError as error:
        return console.fail(f"--namespace: {error}", console.USAGE)
    except BadEndpoint as error:
        return console.fail(str(error), console.USAGE)
    except (NotTheStream, NameTaken) as error:
        return console.fail(str(error))
    return console.OK


async def serve(args: argparse.Namespace, namespace: str, stream: Stream) -> None:
    """Connect to the router and publish the stream until cancelled.

    Raises:
        BadEndpoint: invalid endpoint. NameTaken: another node has the name, or has gained it.
        NotTheStream: the other end is no daemon of this version.
    """
    async with open_session(args.router, args.zenoh) as session:
        node = rmw_zenoh.Node(args.domain, str(session.info.zid()), NAME, namespace)
        if await list_tokens(session, node.others()):
            raise NameTaken(name_taken(node))
        publisher = RosPublisher(session, node, args.humble)
        watching = asyncio.create_task(watch_router(session, args.router, lambda present: None))
        work = [asyncio.create_task(wait_for_rival(session, node))]
        try:
            console.say(f"node {namespace}/{NAME} in domain {node.domain} through {args.router}")
            work.append(asyncio.create_task(forward(stream, args.settings, publisher)))
            ended, _ = await asyncio.wait(work, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            for task in (watching, *work):
                task.cancel()
            await asyncio.gather(*work, return_exceptions=True)
            publisher.close()


def name_taken(node: rmw_zenoh.Node) -> str:
    """Message for two nodes of one name, with a remedy."""
    return (
        f"domain {node.domain} has a node {node.namespace}/{NAME} already; give each robot its own "
        "--namespace, or stop the other one"
    )


async def wait_for_rival(session: zenoh.Session, node: rmw_zenoh.Node) -> None:
    """Wait for a node of the same name with a smaller session ID, which has precedence.

    Two nodes that join at once, as after a wait for the router, do not see each other before; nor do two that were
    separated.

    Raises:
        NameTaken: such a node exists.
    """
    loop, met = asyncio.get_running_loop(), asyncio.Event()

    def on_token(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and rmw_zenoh.session_of(str(sample.key_expr)) < node.session:
            with contextlib.suppress(RuntimeError):  # the loop has closed
                loop.call_soon_threadsafe(met.set)

    subscriber = session.liveliness().declare_subscriber(node.others(), on_token, history=True)
    try:
        await met.wait()
    finally:
        undeclare(subscriber)
    raise NameTaken(name_taken(node))


class RosPublisher:
    """A node with a publisher for each topic."""

    def __init__(self, session: zenoh.Session, node: rmw_zenoh.Node, humble: bool = False) -> None:
        """``humble``: ROS 2 Humble, whose types have no hash."""
        self._tokens = [session.liveliness().declare_token(node.token())]
        self._publishers: dict[str, tuple[zenoh.ext.AdvancedPublisher, bytes]] = {}
        self._sent: dict[str, int] = {}
        for number, (topic, about) in enumerate(TOPICS.items(), 1):
            if topic == "/lumiloop/raw":
                continue
            hashed = rmw_zenoh.UNSUPPORTED if humble else types.STORE.hash_rihs01(about.kind)
            token = node.publisher(number, topic, about.kind, hashed, about.latched)
            publisher = zenoh.ext.declare_advanced_publisher(
                session,
                node.key(topic, about.kind, hashed),
                congestion_control=zenoh.CongestionControl.DROP,
                cache=zenoh.ext.CacheConfig(1) if about.latched else None,
                publisher_detection=about.latched,
                sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
                if about.latched
                else None,
            )
            self._publishers[topic] = publisher, rmw_zenoh.gid_of(token)
            self._tokens.append(session.liveliness().declare_token(token))

    def send(self, out: RosMessage) -> None:
        """Publish one message."""
        if (found := self._publishers.get(out.topic)) is None:
            return
        publisher, gid = found
        number = self._sent[out.topic] = self._sent.get(out.topic, 0) + 1
        publisher.put(out.data, attachment=rmw_zenoh.attachment(number, time.time_ns(), gid))

    def close(self) -> None:
        """Leave the graph."""
        undeclare(*self._tokens, *(publisher for publisher, _ in self._publishers.values()))
