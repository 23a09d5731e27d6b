"""`lumiloop ros2`: a running daemon as a node of ROS 2, which need not be installed here: rmw_zenoh's convention.

The messages are those of the MCAP files. What stands still (map, mount, state) is kept for who comes late, as
transient local does.
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
from taps.ros.messages import TOPICS, Out
from taps.ros.stream_follower import follow
from taps.zenoh_session import BadEndpoint, joined, listed, watched, withdraw

WANTED: Final = ("pose", "lights", "scan", "state", "loop", "faults", "statistics", "map")
NAME: Final = "lumiloop"
HEARTBEAT_S: Final = 0.5
"""Who has missed the last message of a topic that is kept finds out by then, as of rmw_zenoh's own publishers."""


class NameTaken(Exception):
    """Another node has this name; the text says what to do."""


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
    """Join the router and pass on all that is told, until cancelled.

    Raises:
        BadEndpoint: no such router can be. NameTaken: there is such a node, or one has come that stays.
        NotTheStream: there is no such daemon.
    """
    async with joined(args.router, args.zenoh) as session:
        node = rmw_zenoh.Node(args.domain, str(session.info.zid()), NAME, namespace)
        if await listed(session, node.others()):
            raise NameTaken(taken(node))
        talker = Talker(session, node, args.humble)
        watching = asyncio.create_task(watched(session, args.router, lambda there: None))
        work = [asyncio.create_task(rivalled(session, node))]
        try:
            console.say(f"node {namespace}/{NAME} in domain {node.domain} by way of {args.router}")
            work.append(asyncio.create_task(follow(stream, args.settings, talker)))
            ended, _ = await asyncio.wait(work, return_when=asyncio.FIRST_COMPLETED)
            for task in ended:
                task.result()
        finally:
            for task in (watching, *work):
                task.cancel()
            await asyncio.gather(*work, return_exceptions=True)
            talker.close()


def taken(node: rmw_zenoh.Node) -> str:
    """What to do where two nodes have one name."""
    return (
        f"domain {node.domain} has a node {node.namespace}/{NAME} already: two robots on the same topics would "
        "spoil both; give each a --namespace of its own, or stop the other one"
    )


async def rivalled(session: zenoh.Session, node: rmw_zenoh.Node) -> None:
    """Wait for a node of the same name that has the better right to it: the one with the lesser session.

    Two that join at once, as when both have waited for the router, find nobody before them; so do two that were parted.

    Raises:
        NameTaken: there is one.
    """
    loop, met = asyncio.get_running_loop(), asyncio.Event()

    def heard(sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT and rmw_zenoh.session_of(str(sample.key_expr)) < node.session:
            with contextlib.suppress(RuntimeError):  # the loop has closed
                loop.call_soon_threadsafe(met.set)

    listening = session.liveliness().declare_subscriber(node.others(), heard, history=True)
    try:
        await met.wait()
    finally:
        withdraw(listening)
    raise NameTaken(taken(node))


class Talker:
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

    def send(self, out: Out) -> None:
        """One message."""
        if (found := self._publishers.get(out.topic)) is None:
            return
        publisher, gid = found
        number = self._sent[out.topic] = self._sent.get(out.topic, 0) + 1
        publisher.put(out.data, attachment=rmw_zenoh.attachment(number, time.time_ns(), gid))

    def close(self) -> None:
        """Leave the graph."""
        withdraw(*self._tokens, *(publisher for publisher, _ in self._publishers.values()))
