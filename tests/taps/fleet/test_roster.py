"""Who leaves the roster, and how much of it there can be, whatever names, maps and words somebody makes up."""

import os
import tracemalloc

import msgspec
import numpy as np
import pytest

from taps.fleet import drawing, messages, roster
from taps.fleet.messages import StateMessage
from taps.fleet.roster import GONE_S, MOST_INSTANCES, MOST_ROBOTS, Roster
from tests.taps.fleet.test_messages import HEAD, cells, pose_at


def present(made: Roster, robot: str, is_there: bool = True) -> str:
    return made.token(messages.alive(robot, "1.z.h"), is_there)


def tell(made: Roster, robot: str, now: float) -> None:
    made.receive(messages.key(robot, "pose"), pose_at(1.0, 1.0), b"", now)


def noise(side: int) -> tuple[bytes, bytes]:
    """A map that cannot be made smaller, of so many cells a side; larger than it, if anything."""
    head = msgspec.structs.replace(HEAD, columns=side, rows=side)
    return messages.map_message(head, np.frombuffer(os.urandom(side * side), np.int8).reshape(side, side))


def test_who_has_been_gone_for_long_leaves() -> None:
    made = Roster()
    for robot in ("gone", "silent"):
        present(made, robot)
        tell(made, robot, 0.0)
    made.drop_absent(1.0, router=True)
    present(made, "gone", False)
    made.drop_absent(GONE_S, router=True)
    assert list(made.members) == ["gone", "silent"]
    made.drop_absent(GONE_S + 1.5, router=True)
    assert list(made.members) == ["silent"]
    tell(made, "gone", GONE_S + 2.0)
    assert list(made.members) == ["silent", "gone"]


def test_without_a_router_nobody_is_known_to_have_gone() -> None:
    made = Roster()
    present(made, "agv")
    tell(made, "agv", 0.0)
    made.without_router()
    made.drop_absent(5.0 * GONE_S, router=False)
    made.drop_absent(5.0 * GONE_S + 1.0, router=True)
    assert list(made.members) == ["agv"]


def test_names_that_are_made_up_do_not_drive_out_robots_that_are_there() -> None:
    made = Roster()
    present(made, "agv")
    tell(made, "agv", 0.0)
    for number in range(3 * MOST_ROBOTS):
        tell(made, f"forged{number}", 1.0 + number)
    assert len(made.members) == MOST_ROBOTS
    assert "agv" in made.members
    assert made.problems() == []  # who has been gone longest makes room
    for number in range(3 * MOST_ROBOTS):
        present(made, f"present{number}")
    assert len(made.members) == MOST_ROBOTS
    assert made.members["agv"].localised
    assert present(made, "late") == ""
    assert any(f"more than {MOST_ROBOTS} robots" in line for line in made.problems())
    assert len(drawing.table(made.sorted(), 1e4)) == MOST_ROBOTS + 1
    present(made, "present1", False)
    assert present(made, "late") == "late"


def test_no_robot_has_such_a_name() -> None:
    made = Roster()
    assert present(made, 33 * "x") == ""
    tell(made, 33 * "x", 1.0)
    assert not made.members


def test_who_leaves_was_not_there_before() -> None:
    made = Roster()
    present(made, "agv", False)
    assert not made.members


def test_speakers_that_are_made_up_are_some() -> None:
    made = Roster()
    for number in range(50 * MOST_INSTANCES):
        made.token(messages.alive("agv", f"{number}.z.h"), True)
        made.token(messages.waiting("agv", f"{number}.z.h"), True)
    assert len(made.members["agv"].publishers) == len(made.members["agv"].waiting) == MOST_INSTANCES


def test_maps_and_words_that_are_made_up_take_no_more_than_there_is_for_all(monkeypatch: pytest.MonkeyPatch) -> None:
    most = 2 << 20
    monkeypatch.setattr(roster, "MOST_MAPS", most)
    made, large = Roster(), noise(500)
    tracemalloc.start()
    try:
        made.receive(messages.key("agv", "map"), *messages.map_message(HEAD, cells()), 1.0)
        for number in range(100):
            for _ in range(2):  # the second in the place of the first
                made.receive(messages.key(f"forged{number}", "map"), bytes(bytearray(large[0])), large[1], 1.0)
        assert sum(len(one.map.content) for one in made.members.values() if one.map) <= most
        long = messages.encode(StateMessage(t_utc=1.0, meaning=1_000_000 * "x"))
        for number in range(100):
            made.receive(messages.key(f"forged{number}", "state"), long, b"", 1.0)
        kept, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert kept < 2 * most
    assert "forged99: state: the message has 1000" in "\n".join(made.problems())
    made.receive(messages.key("forged0", "map"), *messages.map_message(HEAD, cells()), 2.0)
    made.receive(messages.key("forged50", "map"), *large, 2.0)
    assert made.members["forged50"].map is not None  # what another gave back
    made.receive(messages.key("forged60", "map"), *large, 2.0)
    assert "forged60: map: its map has" in "\n".join(made.problems())
    assert made.members["agv"].map is not None


def test_a_cell_of_the_table_has_an_end() -> None:
    made = Roster()
    made.receive(messages.key("agv", "state"), messages.encode(StateMessage(t_utc=1.0, meaning=50_000 * "x")), b"", 1.0)
    assert max(map(len, drawing.table(made.sorted(), 1.0))) < 500
