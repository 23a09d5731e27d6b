"""Robots, a router and whoever looks, for real on the loopback: late joiners, names, a router that dies."""

import asyncio
import json
import socket
import threading
import time
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")
import zenoh

from daemon.cli import parser
from daemon.publish.stream.client import Stream
from daemon.system import console
from taps import zenoh_session
from taps.fleet import messages, robot, show
from taps.fleet.claim import SURE_S, Claim
from taps.fleet.messages import LoopMessage, StateMessage
from taps.fleet.robot import join
from taps.fleet.roster import MOST_ROBOTS, Roster
from taps.zenoh_session import open_session, session_config
from tests.taps.routers import Heard, Router, beside, router, told_to, until
from tests.taps.serving import served


def speaking(made: Router, path: Path, name: str) -> Any:
    return join(told_to(made, name), Stream(path, robot.WANTED))


def looking(made: Router, roster: Roster) -> Any:
    async def look() -> None:
        async with open_session(made.address) as session:
            listener = show.Collector(session, roster)
            await show.watch_router(session, made.address, listener.on_router)

    return look()


def test_who_comes_late_sees_everything_at_once(tmp_path: Path) -> None:
    """The map is told every 10 s and loops when they are closed: neither has to be waited for."""
    roster = Roster()

    async def body(made: Router) -> None:
        await asyncio.sleep(1.5)  # a loop has been told by now, and the map
        await beside(seen(), looking(made, roster))

    async def seen() -> None:
        await until(lambda: "agv" in roster.members and roster.members["agv"].map, 5.0)
        member = roster.members["agv"]
        await until(lambda: member.loop and member.localised and member.state, 5.0)
        assert member.place == (1.0, 2.0, 3.0)
        assert member.state is not None
        assert (member.state.state_name, member.state.up, member.state.map_id) == ("TRACKING", True, 0xABCD)
        assert len(member.publishers) == 1
        first = member.pose
        await until(lambda: member.pose is not first and member.state.faults)
        assert roster.problems() == []
        assert roster.chart() is not None

    with served(tmp_path / "s"), router() as made:
        asyncio.run(beside(body(made), speaking(made, tmp_path / "s", "agv")))


def test_other_programs_ask_with_zenoh_alone(tmp_path: Path) -> None:
    with served(tmp_path / "s"), router() as made, zenoh.open(session_config("client", made.address)) as session:

        def ask() -> dict[str, Any]:
            found = session.get("lumiloop/*/pose", timeout=1.0)
            return {str(reply.ok.key_expr): json.loads(bytes(reply.ok.payload)) for reply in found}

        async def body() -> None:
            told = (await until(ask))["lumiloop/agv/pose"]
            assert {"x": 1.0, "y": 2.0, "mapId": "0000abcd", "positionInitialized": True}.items() <= told[
                "agvPosition"
            ].items()

        asyncio.run(beside(body(), speaking(made, tmp_path / "s", "agv")))


def test_a_name_that_is_taken_is_said_and_the_first_robot_does_not_suffer(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    roster, heard = Roster(), Heard(capsys)

    async def body(made: Router) -> None:
        await until(lambda: "agv" in roster.members and roster.members["agv"].pose)
        first = roster.members["agv"].publishers.copy()
        # the second one stands elsewhere: were it heard, the place would jump
        other = asyncio.ensure_future(speaking(made, tmp_path / "other", "agv"))
        await until(lambda: heard("the fleet has a robot agv already"))
        await until(lambda: roster.problems())
        assert roster.problems()[0].startswith("agv: 2 robots have this name")
        for _ in range(20):
            await asyncio.sleep(0.05)
            assert roster.members["agv"].place == (1.0, 2.0, 3.0)
        assert roster.members["agv"].publishers == first
        other.cancel()
        await asyncio.gather(other, return_exceptions=True)
        await until(lambda: not roster.problems())

    async def without_router(made: Router) -> None:
        """Who waits for the name hears of nobody while the router is away: that is no reason to take it."""
        await until(lambda: "agv" in roster.members and roster.members["agv"].localised)
        other = asyncio.ensure_future(speaking(made, tmp_path / "other", "agv"))
        await until(lambda: roster.members["agv"].waiting)
        made.end()
        await asyncio.sleep(1.0)
        made.begin()
        await until(lambda: roster.members["agv"].publishers and roster.members["agv"].waiting)
        for _ in range(40):
            await asyncio.sleep(0.05)
            assert roster.members["agv"].place == (1.0, 2.0, 3.0)
        other.cancel()
        await asyncio.gather(other, return_exceptions=True)
        assert not heard("agv is in the fleet", 2)

    async def hand_over(made: Router) -> None:
        first = asyncio.ensure_future(speaking(made, tmp_path / "s", "agv"))
        await until(lambda: "agv" in roster.members and roster.members["agv"].place == (1.0, 2.0, 3.0))
        second = asyncio.ensure_future(speaking(made, tmp_path / "other", "agv"))
        await until(lambda: roster.members["agv"].waiting)
        first.cancel()
        await until(lambda: roster.members["agv"].place == (9.0, 9.0, 0.0))
        second.cancel()
        await asyncio.gather(first, second, return_exceptions=True)

    with served(tmp_path / "s"), served(tmp_path / "other", place=(9.0, 9.0, 0.0)), router() as made:
        asyncio.run(beside(body(made), looking(made, roster), speaking(made, tmp_path / "s", "agv")))
        capsys.readouterr()  # what was said of it before
        roster, heard = Roster(), Heard(capsys)
        asyncio.run(beside(without_router(made), looking(made, roster), speaking(made, tmp_path / "s", "agv")))
        roster = Roster()
        asyncio.run(beside(hand_over(made), looking(made, roster)))


def test_of_two_that_have_spoken_the_first_keeps_the_name(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """As after a partition: the one that claimed it later stops, and goes on when the first has gone."""
    monkeypatch.setattr("taps.fleet.claim.ALONE_S", 1.0)
    roster, heard = Roster(), Heard(capsys)

    async def body(made: Router) -> None:
        await until(lambda: "agv" in roster.members and roster.members["agv"].localised)
        await until(lambda: heard("agv is in the fleet"))
        with zenoh.open(session_config("client", made.address)) as session:
            token = session.liveliness().declare_token(messages.alive("agv", messages.instance_of("zz", "cart", 5)))
            await until(lambda: heard("the fleet has a robot agv already, on cart"))
            await asyncio.sleep(0.2)
            last = roster.members["agv"].pose
            await asyncio.sleep(0.5)
            assert roster.members["agv"].pose is last
            token.undeclare()
        await until(lambda: heard("agv is in the fleet", 2))
        await until(lambda: roster.members["agv"].pose is not last)

    with served(tmp_path / "s"), router() as made:
        asyncio.run(beside(body(made), looking(made, roster), speaking(made, tmp_path / "s", "agv")))


def test_who_leaves_while_the_name_is_asked_for_does_not_keep_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("taps.fleet.claim.ALONE_S", 1.0)
    mine: list[bool] = []

    async def body(made: Router) -> None:
        async with open_session(made.address) as session, open_session(made.address) as other:
            token = other.liveliness().declare_token(messages.alive("agv", messages.instance_of("zz", "cart", 5)))
            await asyncio.sleep(0.2)

            async def list_tokens(*asked: Any) -> list[str]:
                found = await zenoh_session.list_tokens(*asked)
                token.undeclare()
                await asyncio.sleep(0.3)
                return found

            monkeypatch.setattr("taps.fleet.claim.list_tokens", list_tokens)
            await beside(until(lambda: mine[-1:] == [True], 5.0), Claim(session, "agv", "here", mine.append).run())

    with router() as made:
        asyncio.run(body(made))


def test_only_who_is_in_the_fleet_is_said_to_be(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who has the name is heard of a moment after it was asked for: as when two join at once."""
    monkeypatch.setattr("taps.fleet.claim.ALONE_S", 1.0)
    mine: list[bool] = []
    said: list[str] = []

    async def list_tokens(*asked: Any) -> list[str]:
        return []

    monkeypatch.setattr("taps.fleet.claim.list_tokens", list_tokens)

    async def body(made: Router) -> None:
        async with open_session(made.address) as session, open_session(made.address) as other:
            token = other.liveliness().declare_token(messages.alive("agv", messages.instance_of("zz", "cart", 5)))
            await asyncio.sleep(0.2)

            async def seen() -> None:
                await until(lambda: mine[-1:] == [False] and said)
                await asyncio.sleep(2.0 * SURE_S)
                token.undeclare()
                await until(lambda: "agv is in the fleet" in said)

            await beside(seen(), Claim(session, "agv", "here", mine.append, said.append).run())

    with router() as made:
        asyncio.run(body(made))
    assert mine == [True, False, True]
    assert said[0].startswith("the fleet has a robot agv already, on cart")
    assert said[1:] == ["agv is in the fleet"]


def test_a_router_that_dies_is_said_and_all_go_on_when_it_is_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    roster, heard = Roster(), Heard(capsys)

    async def body(made: Router) -> None:
        await until(lambda: "agv" in roster.members and roster.members["agv"].localised)
        member = roster.members["agv"]
        made.end()
        await until(lambda: not member.publishers)
        assert not member.localised
        await until(lambda: heard("is lost; waiting for it", 2))
        old = member.pose
        await asyncio.sleep(0.5)
        assert member.pose is old
        made.begin()
        await until(lambda: member.localised and member.pose is not old)
        assert roster.problems() == []

    with served(tmp_path / "s"), router() as made:
        asyncio.run(beside(body(made), looking(made, roster), speaking(made, tmp_path / "s", "agv")))


def test_a_robot_waits_for_a_router_and_a_daemon(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    roster = Roster()

    async def body(made: Router) -> None:
        await asyncio.sleep(0.3)
        assert capsys.readouterr().err.count(f"no Zenoh router answers at {made.address}; waiting for it") == 2
        made.begin()
        await until(lambda: "agv" in roster.members and roster.members["agv"].state)
        state = roster.members["agv"].state
        assert isinstance(state, StateMessage)
        assert (state.up, state.meaning) == (False, "the daemon does not answer")
        with served(tmp_path / "s"):
            await until(lambda: roster.members["agv"].localised)
        await until(lambda: not roster.members["agv"].state.up)  # type: ignore[union-attr]
        assert not roster.members["agv"].localised
        late = Roster()
        await beside(until(lambda: "agv" in late.members and late.members["agv"].pose), looking(made, late))
        assert late.members["agv"].place == (1.0, 2.0, 3.0)
        assert late.members["agv"].pose.agvPosition["positionInitialized"] is False  # type: ignore[union-attr,index]

    with router() as made:
        made.end()
        asyncio.run(beside(body(made), looking(made, roster), speaking(made, tmp_path / "s", "agv")))


def test_a_router_that_takes_the_connection_and_says_nothing_is_said_and_holds_up_no_stop(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    heard = Heard(capsys)

    async def stop() -> None:
        await until(lambda: heard("no Zenoh router answers"))

    async def join(address: str) -> None:
        async with open_session(address):
            pytest.fail("there is none")

    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setattr("taps.zenoh_session.LEASE_S", 0.5)
        begun = time.monotonic()
        asyncio.run(beside(stop(), join(f"127.0.0.1:{silent.getsockname()[1]}")))
        assert time.monotonic() - begun < 3.0


def in_a_loop_of_its_own(words: list[str]) -> int:
    """The command, in a thread that cannot take signals."""
    args = parser.parser().parse_args(words)
    return int(args.body(args))


def test_the_command_shows_all_robots_on_one_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    async def body(made: Router, words: list[str]) -> None:
        await asyncio.sleep(1.0)
        assert await asyncio.to_thread(in_a_loop_of_its_own, ["fleet", "--router", made.address, *words]) == console.OK

    picture = tmp_path / "fleet.png"
    with served(tmp_path / "s"), served(tmp_path / "t", place=(3.0, -4.0, 1.0)), router() as made:
        for words in (["--picture", str(picture)], ["--json"]):
            works = (speaking(made, tmp_path / "s", "agv1"), speaking(made, tmp_path / "t", "agv2"))
            capsys.readouterr()
            asyncio.run(beside(body(made, words), *works))
            text = capsys.readouterr().out
            if words == ["--json"]:
                robots = json.loads(text)["robots"]
                assert {name: one["pose"]["agvPosition"]["x"] for name, one in robots.items()} == {
                    "agv1": 1.0,
                    "agv2": 3.0,
                }
                assert all(one["alive"] for one in robots.values())
                continue
            *drawn, first, second, said = text.splitlines()
            assert first.split()[:7] == ["1", "agv1", "TRACKING", "1.00", "2.00", "172", "0.10"]
            assert second.split()[:6] == ["2", "agv2", "TRACKING", "3.00", "-4.00", "57"]
            assert any("2" in line and "#" in line for line in drawn)
            assert said == f"{picture}: agv2 red"  # agv1 is beyond the tile that there is
            assert picture.read_bytes()[:4] == b"\x89PNG"
        assert parser.main(["fleet", "--router", made.address]) == console.FAILED
        assert "no robot publishes" in capsys.readouterr().err


def test_whoever_makes_up_names_and_messages_does_not_fill_the_viewer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("taps.fleet.show.MOST_WAITING", 1 << 20)
    monkeypatch.setattr("taps.fleet.roster.GONE_S", 0.2)
    roster, asking = Roster(), []

    async def body(made: Router) -> None:
        await until(lambda: "agv" in roster.members and roster.members["agv"].localised)
        async with open_session(made.address) as session:
            tokens = []
            for number in range(600):
                tokens.append(session.liveliness().declare_token(messages.alive(f"forged{number}", "1.z.h")))
                session.put(messages.key(f"forged{number}", "map"), bytes(50_000))
            begun = time.monotonic()
            while time.monotonic() - begun < 1.0:
                await asyncio.sleep(0.02)
                asking.append(sum(one.name == "lumiloop-zenoh" for one in threading.enumerate()))
            assert len(roster.members) == MOST_ROBOTS
            assert roster.members["agv"].localised
            assert any("more than" in line for line in roster.problems())
            assert len(tokens) == 600
            assert 1 < max(asking) <= show.MOST_QUERIES + 1
        await until(lambda: not any(one.present for one in roster.members.values() if one.name != "agv"))
        await asyncio.sleep(0.3)
        roster.drop_absent(time.monotonic(), router=True)
        assert list(roster.members) == ["agv"]
        old = roster.members["agv"].pose
        await until(lambda: roster.members["agv"].pose is not old)

    with served(tmp_path / "s"), router() as made:
        asyncio.run(beside(body(made), looking(made, roster), speaking(made, tmp_path / "s", "agv")))


def test_messages_that_wait_have_a_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """The loop stands while they come: what is beyond the bound is left out, and later ones are heard."""
    monkeypatch.setattr("taps.fleet.show.MOST_WAITING", 100_000)
    roster = Roster()

    async def body(made: Router) -> None:
        async with open_session(made.address) as session:
            await until(lambda: session.info.routers_zid())
            listener = show.Collector(session, roster)
            await asyncio.sleep(0.3)
            with zenoh.open(session_config("client", made.address)) as other:
                for number in range(20):
                    other.put(messages.key(f"agv{number}", "state"), bytes(20_000))
                time.sleep(1.0)  # noqa: ASYNC251  the loop stands
                await until(lambda: roster.members)
                assert 1 <= len(roster.members) <= 4
                other.put(messages.key("late", "state"), bytes(20_000))
                await until(lambda: "late" in roster.members)
            assert listener.present

    with router() as made:
        asyncio.run(body(made))


def test_who_asks_once_does_not_wait_for_ever(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("taps.fleet.show.ROUTER_S", 0.3)
    assert parser.main(["fleet", "--json", "--router", "tcp/127.0.0.1:1"]) == console.FAILED
    told = capsys.readouterr()
    assert told.out == ""
    assert "no router answers at tcp/127.0.0.1:1 within 0.3 s; start one with `lumiloop fleet router`" in told.err


def test_what_is_new_in_a_message_is_skipped() -> None:
    told = messages.read(b'{"t_utc": 1, "counter": 3, "at_new": [1, 2, 3], "new": 1}', LoopMessage)
    assert (told.counter, told.at_new, told.at_old) == (3, (1, 2, 3), None)
