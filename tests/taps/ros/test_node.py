"""A node of ROS 2 without ROS, as rmw_zenoh's subscribers see it: names, content, who comes late, what goes wrong."""

import asyncio
import struct
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rosbags", reason="pip install 'lumiloop[zenoh]'")
pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")
import zenoh
from rosbags.typesys import Stores, get_typestore

from daemon.publish.stream.client import Stream
from taps.ros import node, rmw_zenoh, types
from taps.ros.messages import TOPICS
from taps.zenoh_session import session_config
from tests.taps.routers import beside, router, told_to, until
from tests.taps.serving import served

JAZZY = get_typestore(Stores.ROS2_JAZZY)
PUBLISHED = {topic: about for topic, about in TOPICS.items() if topic != "/lumiloop/raw"}


class Subscriber:
    """As rmw_zenoh subscribes: the whole key, and for transient local the history of who comes before and after."""

    def __init__(self, session: Any, topic: str, namespace: str = "", domain: int = 0) -> None:
        about = TOPICS[topic]
        self.got: list[tuple[bytes, tuple[int, int, bytes]]] = []
        key = rmw_zenoh.Node(domain, "", "", namespace).key(topic, about.kind, types.STORE.hash_rihs01(about.kind))
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1) if about.latched else None
        recovery = zenoh.ext.RecoveryConfig(heartbeat=True) if about.latched else None
        self._subscriber = zenoh.ext.declare_advanced_subscriber(
            session, key, self._take, history=history, recovery=recovery, subscriber_detection=about.latched
        )

    def _take(self, sample: Any) -> None:
        kind = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
        self.got.append((bytes(sample.payload), zenoh.ext.z_deserialize(kind, sample.attachment)))


def serve(made: Any, path: Path, namespace: str = "", domain: int = 0) -> Any:
    args = told_to(made, domain=domain, humble=False)
    return node.serve(args, namespace, Stream(path, node.WANTED))


def test_what_a_subscriber_of_ros_gets(tmp_path: Path) -> None:
    with served(tmp_path / "s"), router() as made, zenoh.open(session_config("client", made.address)) as session:
        pose, scan = (Subscriber(session, topic, "/agv", 7) for topic in ("/pose", "/scan"))

        async def body() -> None:
            await until(lambda: len(pose.got) >= 20 and len(scan.got) >= 20)

        asyncio.run(beside(body(), serve(made, tmp_path / "s", "/agv", 7)))
    numbers = [attachment[0] for _, attachment in pose.got]
    assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
    assert all(abs(t_ns - time.time_ns()) < 60e9 for _, (_, t_ns, _) in pose.got)
    assert len({gid for _, (_, _, gid) in pose.got}) == 1
    assert pose.got[0][1][2] != scan.got[0][1][2]
    read = JAZZY.deserialize_cdr(scan.got[0][0], "sensor_msgs/msg/LaserScan")
    assert read.header.frame_id == "laser"
    assert len(read.ranges) > 0
    # the pose by hand, as XCDR1 has it: encapsulation, stamp, frame (4 letters with their 0), 7 doubles, covariance
    data = pose.got[0][0]
    assert data[:4] == b"\x00\x01\x00\x00"
    sec, _, length = struct.unpack_from("<iII", data, 4)
    assert abs(sec - 1.7e9) < 100
    assert (length, data[16:20]) == (4, b"map\x00")
    assert struct.unpack_from("<3d", data, 4 + 16) == (1.0, 2.0, 0.0)
    assert struct.unpack_from("<36d", data, 4 + 16 + 56)[0] == pytest.approx(0.01)


def test_the_graph_that_ros2_topic_list_is_made_of(tmp_path: Path) -> None:
    found: list[str] = []
    with served(tmp_path / "s"), router() as made, zenoh.open(session_config("client", made.address)) as session:

        def graph() -> list[str]:
            return [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/0/**", timeout=1.0)]

        pose = Subscriber(session, "/pose")

        async def body() -> None:
            found.extend(await until(lambda: pose.got and len(tokens := graph()) > len(PUBLISHED) and tokens))

        asyncio.run(beside(body(), serve(made, tmp_path / "s")))
        assert graph() == []
    (token,) = (token for token in found if "/%pose/" in token)
    assert {gid for _, (_, _, gid) in pose.got} == {rmw_zenoh.gid_of(token)}
    words = sorted((token.split("/") for token in found), key=lambda one: int(one[4]))
    assert {tuple(one[:4]) for one in words} == {("@ros2_lv", "0", words[0][2], "0")}
    assert words[0][4:] == ["0", "NN", "%", "%", "lumiloop"]
    assert [one[5:9] for one in words[1:]] == [["MP", "%", "%", "lumiloop"]] * len(PUBLISHED)
    assert {one[9]: one[10] for one in words[1:]} == {
        topic.replace("/", "%"): rmw_zenoh.dds_name(about.kind) for topic, about in PUBLISHED.items()
    }
    kept = {one[9] for one in words[1:] if one[12].startswith(":1:")}
    assert kept == {topic.replace("/", "%") for topic, about in PUBLISHED.items() if about.latched}


def test_who_comes_late_gets_what_stands_still_also_after_the_router_was_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The mount is told every 5 s, the state at a change: both come at once, and the pose goes on."""

    async def late(made: Any) -> None:
        with zenoh.open(session_config("client", made.address)) as session:
            kept = [Subscriber(session, topic) for topic in ("/tf_static", "/lumiloop/state", "/map")]
            pose = Subscriber(session, "/pose")
            await until(lambda: all(one.got for one in kept) and pose.got, 4.0)
            assert [one.got[0][1][0] for one in kept[1:]] == [1, 1]
            assert JAZZY.deserialize_cdr(kept[2].got[0][0], "nav_msgs/msg/OccupancyGrid").info.width == 128

    async def body(made: Any) -> None:
        await asyncio.sleep(1.5)
        await late(made)
        made.end()
        await until(lambda: "is lost; waiting for it" in capsys.readouterr().err)
        made.begin()
        await until(lambda: "again" in capsys.readouterr().err)
        await late(made)

    with served(tmp_path / "s"), router() as made:
        asyncio.run(beside(body(made), serve(made, tmp_path / "s")))


def test_a_second_node_of_the_name_is_refused_and_the_first_does_not_suffer(tmp_path: Path) -> None:
    with served(tmp_path / "s"), router() as made, zenoh.open(session_config("client", made.address)) as session:
        pose = Subscriber(session, "/pose")

        async def body() -> None:
            await until(lambda: pose.got)
            with pytest.raises(node.NameTaken, match=r"domain 0 has a node /lumiloop already.*--namespace"):
                await serve(made, tmp_path / "s")
            before = len(pose.got)
            await until(lambda: len(pose.got) > before + 10)

        asyncio.run(beside(body(), serve(made, tmp_path / "s")))
        assert len({gid for _, (_, _, gid) in pose.got}) == 1


def test_of_two_that_join_at_once_or_meet_again_one_stays(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Both have waited for the router, and neither finds the other in the list: no topic may have two publishers."""

    async def nobody(session: Any, key: str) -> list[str]:
        return []

    monkeypatch.setattr(node, "list_tokens", nobody)
    with served(tmp_path / "s"), router() as made, zenoh.open(session_config("client", made.address)) as session:
        pose = Subscriber(session, "/pose")

        async def both() -> None:
            two = [asyncio.create_task(serve(made, tmp_path / "s")) for _ in range(2)]
            ended, (stays,) = await asyncio.wait(two, timeout=20.0, return_when=asyncio.FIRST_COMPLETED)
            (stopped,) = ended
            with pytest.raises(node.NameTaken, match="has a node /lumiloop already"):
                stopped.result()
            await asyncio.sleep(0.3)
            pose.got.clear()
            await until(lambda: len(pose.got) > 10)
            assert not stays.done()
            assert len({gid for _, (_, _, gid) in pose.got}) == 1
            stays.cancel()
            await asyncio.gather(stays, return_exceptions=True)

        asyncio.run(both())
