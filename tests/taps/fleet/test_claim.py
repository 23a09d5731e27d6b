"""What a robot keeps in mind for months: who has had its name, and what its map is called."""

from __future__ import annotations

from typing import Any, cast

import pytest
import zenoh

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
