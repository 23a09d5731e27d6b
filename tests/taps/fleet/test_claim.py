"""What a robot keeps in mind for months: who has had its name, and what its map is called."""

import json
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import zenoh

from daemon.publish.stream.messages import Pose
from daemon.snapshot import State
from taps.fleet import robot
from taps.fleet.claim import Claim
from taps.fleet.robot import Robot


def test_who_has_gone_is_forgotten() -> None:
    claim = Claim(cast(zenoh.Session, None), "agv", "here", lambda mine: None, lambda text: None)
    claim._on_claim("gone before the list has come", False)
    assert claim._others, "or the list would bring it back"
    claim._instance = "5"
    for k in range(1000):
        claim._on_claim(f"6-{k}", True)
        claim._on_claim(f"6-{k}", False)
    claim._on_claim("4", True)
    assert claim._before() == "4"
    claim._on_claim("4", False)
    assert claim._before() == ""
    assert len(claim._others) <= 1


def test_a_map_that_is_named_later_is_told_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    named, looked, now = {7: ""}, [0], [100.0]

    def name_of(folder: str, map_id: int) -> str:
        looked[0] += 1
        return named[map_id]

    monkeypatch.setattr(robot, "name_of", name_of)
    monkeypatch.setattr(robot.time, "monotonic", lambda: now[0])
    told = Robot(cast(Any, None), cast(Any, None), "maps")
    assert [told._map_name(7) for _ in range(5)] == [""] * 5
    assert looked == [1]
    named[7] = "hall 3"
    now[0] += robot.NAME_S
    assert [told._map_name(7) for _ in range(5)] == ["hall 3"] * 5
    now[0] += robot.NAME_S
    told._map_name(7)
    assert looked == [2]


def test_no_two_poses_of_one_instant_are_published(monkeypatch: pytest.MonkeyPatch) -> None:
    """Cycles without a measurement and late corrections repeat the instant; lost validity is published all the same."""
    sent: list[tuple[float, bool]] = []

    def publish(key: str, content: bytes, attachment: bytes | None = None) -> None:
        if key == "pose":
            told = json.loads(content)
            sent.append((told["t_utc"], told["agvPosition"]["positionInitialized"]))

    robot_ = Robot(cast(Any, SimpleNamespace(publish=publish)), cast(Any, SimpleNamespace(held=dict)), "maps")
    monkeypatch.setattr(robot_, "_map_name", lambda map_id: "")
    pose = Pose(
        seq=1, t_mono=1.0, t_sent=1.0, t_utc=1001.0, state=State.TRACKING, state_name="TRACKING", reason=0,
        pose=(1.0, 2.0, 0.0), covariance=(0.01, 0.0, 0.01, 0.0, 0.0, 0.01),
    )  # fmt: skip
    for frame in (
        pose,
        msgspec.structs.replace(pose, seq=2, t_sent=1.5, t_utc=1001.5),
        msgspec.structs.replace(pose, seq=3, t_sent=1.6, t_utc=1001.6, pose=(1.5, 2.0, 0.0)),
        msgspec.structs.replace(pose, seq=4, t_mono=2.0, t_sent=2.0, t_utc=1002.0),
        msgspec.structs.replace(pose, seq=5, t_mono=2.0, t_sent=2.5, t_utc=1002.5, state=State.LOST, covariance=None),
    ):
        robot_.receive(frame)
        robot_.beat()
    assert sent == [(1001.0, True), (1002.0, True), (1002.0, False)]
