"""The Foxglove live server, as the app sees it: over its WebSocket protocol (subprotocol foxglove.sdk.v1)."""

import asyncio
import json
import struct
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("aiohttp", reason="pip install 'lumiloop[view]'")
pytest.importorskip("foxglove", reason="pip install 'lumiloop[foxglove]'")
import aiohttp

from daemon.config.schema import Config
from daemon.publish.stream.client import Stream
from taps.foxglove import live
from taps.foxglove.live import Bridge
from taps.ros import types
from taps.ros.messages import TOPICS
from taps.ros.stream_follower import forward
from tests.taps.serving import served


async def watched(port: int, wanted: set[str]) -> tuple[dict[str, Any], dict[str, bytes]]:
    """The channels that are advertised, and a first message of each that is wanted."""
    channels: dict[str, Any] = {}
    got: dict[str, bytes] = {}
    async with aiohttp.ClientSession() as session:
        url = f"ws://127.0.0.1:{port}"
        async with session.ws_connect(url, protocols=["foxglove.sdk.v1"]) as socket, asyncio.timeout(10.0):
            while set(got) != wanted:
                message = await socket.receive()
                if message.type == aiohttp.WSMsgType.TEXT:
                    told = json.loads(message.data)
                    fresh = told.get("channels", []) if told["op"] == "advertise" else []
                    channels |= {channel["topic"]: channel for channel in fresh}
                    ask = [{"id": c["id"], "channelId": c["id"]} for c in fresh if c["topic"] in wanted]
                    await socket.send_str(json.dumps({"op": "subscribe", "subscriptions": ask}))
                elif message.type == aiohttp.WSMsgType.BINARY and message.data[0] == 1:
                    number, _ = struct.unpack_from("<IQ", message.data, 1)
                    topic = next(name for name, channel in channels.items() if channel["id"] == number)
                    got.setdefault(topic, message.data[13:])
    return channels, got


def test_the_app_sees_every_topic_and_who_comes_late_gets_the_map(tmp_path: Path) -> None:
    async def run() -> tuple[dict[str, Any], dict[str, bytes]]:
        bridge = Bridge("127.0.0.1", 0, "agv")
        running = asyncio.ensure_future(forward(Stream(tmp_path / "s", live.WANTED), Config(), bridge))
        try:
            await asyncio.sleep(0.5)  # the map has been told by now, and is not told again
            return await watched(bridge.port, {"/scan", "/pose", "/map", "/tf", "/tf_static"})
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            bridge.close()

    with served(tmp_path / "s"):
        channels, got = asyncio.run(run())
    assert set(channels) == set(TOPICS) - {"/lumiloop/raw"}
    for topic, channel in channels.items():
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
        assert channel["schemaName"] == TOPICS[topic].kind
    pose = types.STORE.deserialize_cdr(got["/pose"], "geometry_msgs/msg/PoseWithCovarianceStamped")
    assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (1.0, 2.0)
    grid = types.STORE.deserialize_cdr(got["/map"], "nav_msgs/msg/OccupancyGrid")
    assert grid.info.width == 128
