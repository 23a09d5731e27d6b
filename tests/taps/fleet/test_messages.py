"""What robots tell each other: messages come back, damaged ones are refused, and who is who in the roster."""

import json
import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.publish.stream.messages import Fault, Pose, Trust
from taps.fleet import drawing, messages
from taps.fleet.messages import Held, MapHead, PoseMessage, StateMessage, Unreadable
from taps.fleet.roster import Roster
from taps.metrics.vda5050 import position_v2
from taps.stream.tiles import FREE, UNSEEN, WALL

POSE = Pose(
    seq=1, t_mono=1.0, t_sent=1.0, t_utc=1.7e9, state=3, state_name="TRACKING", reason=0, pose=(1.0, 2.0, 7.0),
    map_id=0xAB, covariance=(1.0, 0.0, 1.0, 0.0, 0.0, 1.0), known=(True, True, False), trust=Trust(horizontal_m=0.25),
)  # fmt: skip
HEAD = MapHead(t_utc=1.7e9, map_id=0xAB, resolution=0.5, columns=8, rows=6, origin=(-1.0, -1.0))


def cells() -> messages.Cells:
    made = np.full((6, 8), FREE, np.int8)
    made[0], made[:, 0] = WALL, WALL
    made[5, 7] = UNSEEN
    return made


def pose_at(x: float, y: float, map_id: str = "000000ab", initialised: bool = True) -> bytes:
    at = {"x": x, "y": y, "theta": 0.0, "mapId": map_id, "positionInitialized": initialised, "deviationRange": 0.25}
    return messages.encode(PoseMessage(seq=1, t_utc=1.7e9, agvPosition=at))


def test_the_position_object_has_the_standards_names_and_ranges() -> None:
    told = position_v2(POSE, description="hall 3")
    assert told is not None
    assert set(told) == {
        *("x", "y", "mapId", "theta", "positionInitialized"),
        *("localizationScore", "deviationRange", "mapDescription"),
    }
    assert (told["mapId"], told["mapDescription"], told["deviationRange"]) == ("000000ab", "hall 3", 0.25)
    assert told["localizationScore"] == 0.67
    assert -math.pi <= float(str(told["theta"])) <= math.pi
    lost = position_v2(msgspec.structs.replace(POSE, state=6), POSE)
    assert lost is not None
    assert (lost["positionInitialized"], lost["localizationScore"]) == (False, 0.0)
    assert not {"deviationRange", "mapDescription"} & set(lost)


def test_a_pose_in_json_is_what_the_standard_has() -> None:
    told = json.loads(messages.encode(PoseMessage(seq=1, t_utc=1.7e9, agvPosition=position_v2(POSE))))
    assert told["agvPosition"]["x"] == 1.0
    assert told["schema"] == 1
    assert messages.read(messages.encode(PoseMessage(seq=1, t_utc=1.0)), PoseMessage).agvPosition is None


def test_a_map_comes_back() -> None:
    head, made = messages.read_map(*messages.map_message(HEAD, cells()))
    assert head == HEAD
    assert np.array_equal(made, cells())


@given(st.integers(0, 500), st.binary(min_size=1, max_size=4))
def test_a_damaged_map_is_refused_or_another_map(at: int, damage: bytes) -> None:
    content, attachment = messages.map_message(HEAD, cells())
    at %= len(content)
    spoilt = content[:at] + damage + content[at + len(damage) :]
    try:
        _, made = messages.read_map(spoilt, attachment)
    except Unreadable:
        return
    assert made.shape == (6, 8)


@pytest.mark.parametrize(
    ("attachment", "words"),
    [
        (b"", "not a lumiloop message"),
        (messages.encode(msgspec.structs.replace(HEAD, schema=2)), "schema 2"),
        (messages.encode(msgspec.structs.replace(HEAD, rows=0)), "8 x 0"),
        (messages.encode(msgspec.structs.replace(HEAD, rows=10**9)), "8 x 1000000000"),
        (messages.encode(msgspec.structs.replace(HEAD, rows=5)), "instead of 40"),
        (messages.encode(msgspec.structs.replace(HEAD, resolution=0.0)), "cells of 0.0 m"),
    ],
)
def test_what_is_no_map_is_refused(attachment: bytes, words: str) -> None:
    with pytest.raises(Unreadable, match=words):
        messages.read_map(messages.map_message(HEAD, cells())[0], attachment)


def test_one_robot_that_tells_rubbish_does_not_hide_the_others() -> None:
    roster = Roster()
    for robot, content in (("agv1", pose_at(1.0, 1.0)), ("agv2", b"\xff{"), ("agv3", b'{"seq": 1, "t_utc": 0}')):
        roster.token(messages.alive(robot, "1.z.h"), True)
        roster.receive(messages.key(robot, "pose"), content, b"", 5.0)
    roster.receive("lumiloop/agv4/else", b"", b"", 5.0)
    roster.receive("other/agv4/pose", b"", b"", 5.0)
    assert list(roster.members) == ["agv1", "agv2", "agv3"]
    assert [one.localised for one in roster.sorted()] == [True, False, False]
    (problem,) = roster.problems()
    assert problem.startswith("agv2: pose: not a lumiloop message")
    assert "agv2" in "\n".join(drawing.table(roster.sorted(), 6.0))


@pytest.mark.parametrize("x", ['"1"', "null", "1e999", "1" + 400 * "0", "[1]", "true"])
def test_a_place_that_is_none_is_shown_as_none(x: str) -> None:
    roster = Roster()
    content = b'{"seq": 1, "t_utc": 0, "agvPosition": {"x": %s, "y": 0, "theta": 0, "mapId": 3}}' % x.encode()
    roster.receive(messages.key("agv1", "pose"), content, b"", 1.0)
    assert roster.members["agv1"].place is None
    assert drawing.table(roster.sorted(), 1.0)[1].split()[:4] == ["1", "agv1", "GONE", "-"]


def test_what_others_tell_does_not_reach_the_terminal_as_orders() -> None:
    roster = Roster()
    state = StateMessage(t_utc=1.0, state_name="\x1b[2J", meaning="line\nline \x07\u202e", faults=())
    roster.receive("lumiloop/agv\x1b]0;x/state", messages.encode(state), b"", 1.0)
    roster.receive("lumiloop/agv\x1b]0;x/pose", b"\x1b", b"", 1.0)
    lines = [*drawing.table(roster.sorted(), 1.0), *roster.problems()]
    assert len(lines) == 3
    assert all(line.isprintable() for line in lines)


def test_who_is_there_twice_and_who_is_behind_is_said() -> None:
    roster = Roster()
    assert roster.token(messages.alive("agv1", messages.instance_of("z1", "cart 7", 5)), True) == "agv1"
    assert roster.token(messages.waiting("agv1", messages.instance_of("z2", "cart9", 6)), True) == ""
    for robot, version in (("agv1", 6), ("agv2", 7)):
        state = StateMessage(
            t_utc=1.0, held={"survey": Held(version, "aa")}, faults=(Fault(fault=104, meaning="no scan"),)
        )
        roster.receive(messages.key(robot, "state"), messages.encode(state), b"", 1.0)
    twice, behind = roster.problems()
    assert twice.startswith("agv1: 2 robots have this name, on cart-7, cart9")
    assert behind.startswith("agv1: the newest survey, 7")
    assert "104 no scan" in drawing.table(roster.sorted(), 2.0)[1]
    roster.without_router()
    assert [row.split()[2] for row in drawing.table(roster.sorted(), 2.0)[1:]] == ["GONE", "GONE"]


def test_robots_stand_on_the_map_where_they_are() -> None:
    roster = Roster()
    roster.receive(messages.key("agv1", "map"), *messages.map_message(HEAD, cells()), 1.0)
    places = {"agv1": (0.25, 0.25), "agv2": (2.25, 1.25), "elsewhere": (0.25, 0.25), "outside": (50.0, 1.0)}
    for robot, (x, y) in places.items():
        content = pose_at(x, y, "00000001" if robot == "elsewhere" else "000000ab", initialised=robot != "agv2")
        roster.token(messages.alive(robot, "1.z.h"), True)
        roster.receive(messages.key(robot, "pose"), content, b"", 1.0)
    chart = roster.chart()
    assert chart is not None
    found = {
        member.name: (int(row), int(column)) for _, member, row, column in drawing.on_chart(chart, roster.sorted())
    }
    assert found == {"agv1": (2, 2), "agv2": (4, 6)}
    lines = drawing.plan(chart, roster.sorted())
    assert [line[:8] for line in lines[:3]] == ["#.....2.", "#.1.....", "########"]
    pixels, said = drawing.picture(chart, roster.sorted())
    assert said == ["agv1 blue", "agv2 red (last received pose)"]
    scale = len(pixels) // 6
    assert tuple(pixels[-(2 * scale + scale // 2), 2 * scale + scale // 2]) == drawing.COLOURS[0][1]


def test_a_map_of_nothing_seen_is_drawn_too() -> None:
    chart = HEAD, np.full((6, 8), UNSEEN, np.int8)
    assert drawing.plan(chart, [])[-1] == "map 000000ab, 4 x 3 m"
    assert (drawing.picture(chart, [])[0] == drawing.SHADES[UNSEEN]).all()
