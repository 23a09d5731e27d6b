"""Commands: their order and outcome in the daemon, and the local socket that takes them."""

import asyncio
import contextlib
import json
import logging
import socket
import stat
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from daemon.publish import command_socket
from daemon.publish.command_messages import LONGEST_REQUEST
from daemon.publish.command_socket import CLIENTS, CommandSocket
from daemon.publish.commands import ASKED, NO_RECORDER, OnEnd, Orders
from daemon.publish.feeds import Feeds
from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from daemon.snapshot import State
from daemon.system.callbacks import OnDone
from estimator.measurements import Command, Order
from hal.errors import DeviceRefused
from tests.daemon.publish.modbus.test_registers import snapshot
from tests.daemon.publish.network import closed, until


class Clock:
    """Stands still until it is moved on."""

    t = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> float:
        return self.t


class Asking:
    """Orders with what they set off."""

    def __init__(self, **able: Any) -> None:
        self.ended: list[tuple[int, Outcome]] = []
        self.commands: list[Command] = []
        self.saves: list[OnDone] = []
        feeds = Feeds(lambda _: None, lambda _: None, self.commands.append, self.saves.append, **able)

        self.clock = Clock()
        self.orders = Orders(self.clock, feeds)

    def ask(self, number: int, code: CommandCode, map_id: int = 0) -> None:
        request = Request(number, code, (1.0, 2.0, 0.5), map_id)
        self.orders.handle(request, lambda outcome, _: self.ended.append((number, outcome)))


@pytest.mark.parametrize("order", [Order.SET_POSE, Order.RESET, Order.RELOCALISE])
def test_the_estimators_orders_are_done_when_a_pose_is_published(order: Order) -> None:
    bench = Asking()
    bench.ask(7, CommandCode[order.name])
    assert [command.order for command in bench.commands] == [order]
    assert (bench.commands[0].T_map_base is not None) == (order is Order.SET_POSE)
    bench.orders.published(snapshot(pose=None))
    assert bench.ended == []
    bench.orders.published(snapshot())
    bench.orders.published(snapshot())
    assert bench.ended == [(7, Outcome.DONE)]


def test_a_pause_is_done_with_the_next_snapshot_pose_or_not() -> None:
    bench = Asking()
    bench.ask(3, CommandCode.PAUSE)
    bench.ask(4, CommandCode.RESUME)
    bench.ask(5, CommandCode.RESET)
    assert bench.ended == []
    bench.orders.published(snapshot(pose=None))
    assert [command.order for command in bench.commands] == [Order.PAUSE, Order.RESUME, Order.RESET]
    assert bench.ended == [(3, Outcome.DONE), (4, Outcome.DONE)]


def test_orders_that_wait_for_a_pose_do_not_pile_up() -> None:
    bench = Asking()
    for number in range(1, 1001):
        bench.ask(number, CommandCode.RELOCALISE)
    bench.orders.published(snapshot())
    assert len(bench.ended) == ASKED
    assert bench.ended[-1] == (1000, Outcome.DONE)


def test_orders_at_any_rate_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """A controller that orders a hundred times a second for a minute, and is refused each time."""
    bench = Asking()
    clock = bench.clock

    def go_on(seconds: int) -> list[str]:
        caplog.clear()
        with caplog.at_level(logging.INFO):
            for number in range(100 * seconds):
                clock.t += 0.01
                bench.ask(1 + number, CommandCode.DUMP_RECORDER)
        return [record.getMessage() for record in caplog.records]

    lines = go_on(60)
    assert len(lines) <= 70
    assert lines[:2] == ["Modbus: DUMP_RECORDER", f"Modbus: DUMP_RECORDER refused: {NO_RECORDER}"]
    assert sum("more such lines were skipped before it" in line for line in lines) == 5
    assert "(1990 more such lines were skipped before it)" in lines[10]
    clock.t += 60.0
    assert len(go_on(1)) == 10, "an order now and then is told as ever"
    assert len(bench.ended) == 6100


def test_what_takes_long_is_done_when_it_says_so(caplog: pytest.LogCaptureFixture) -> None:
    dumps: list[OnDone] = []
    switches: list[tuple[int, OnDone]] = []
    bench = Asking(on_dump=dumps.append, on_switch=lambda map_id, told: switches.append((map_id, told)))
    bench.ask(1, CommandCode.SAVE_MAP)
    bench.ask(2, CommandCode.DUMP_RECORDER)
    bench.ask(3, CommandCode.SWITCH_MAP, 0xABC)
    bench.orders.published(snapshot())
    assert bench.ended == []
    bench.saves[0]("")
    dumps[0]("the disk is full")
    switches[0][1]("")
    assert switches[0][0] == 0xABC
    assert bench.ended == [(1, Outcome.DONE), (2, Outcome.REFUSED), (3, Outcome.DONE)]
    assert "DUMP_RECORDER refused: the disk is full" in caplog.text


@pytest.mark.parametrize("code", [CommandCode.DUMP_RECORDER, CommandCode.SWITCH_MAP])
def test_what_a_run_cannot_do_is_refused(code: CommandCode) -> None:
    bench = Asking()
    bench.ask(9, code)
    assert bench.ended == [(9, Outcome.REFUSED)]


def test_whatever_goes_wrong_with_an_order_its_client_hears_of_its_end(caplog: pytest.LogCaptureFixture) -> None:
    def broken(told: OnDone) -> None:
        raise MemoryError

    bench = Asking(on_dump=broken)
    bench.ask(5, CommandCode.DUMP_RECORDER)
    assert bench.ended == [(5, Outcome.REFUSED)]
    assert "DUMP_RECORDER refused: the command has failed: MemoryError()" in caplog.text


class Bench:
    """A served socket; requests are kept with their callbacks, and nothing answers them by itself."""

    def __init__(self, path: Path) -> None:
        self.taken: list[tuple[Request, OnEnd]] = []
        self.server = CommandSocket(path, lambda request, on_end, source: self.taken.append((request, on_end)))

    async def ask(self, message: object) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        line = message if isinstance(message, bytes) else json.dumps(message).encode() + b"\n"
        reader, writer = await asyncio.open_unix_connection(str(self.server.path))
        writer.write(line)
        return reader, writer

    async def answer(self, message: object) -> dict[str, Any]:
        reader, writer = await self.ask(message)
        with contextlib.closing(writer):
            said: dict[str, Any] = json.loads(await closed(reader))
        return said


@contextlib.asynccontextmanager
async def serving(folder: Path) -> AsyncIterator[Bench]:
    bench = Bench(folder / "agv.commands")
    running = asyncio.create_task(bench.server.run())
    for _ in range(3):  # it binds in its first step, and serves in the next
        await asyncio.sleep(0)
    await until(lambda: running.done() or bench.server.path.is_socket())
    try:
        yield bench
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def test_an_order_ends_with_its_result_and_the_state(tmp_path: Path) -> None:
    async with serving(tmp_path) as bench:
        reader, writer = await bench.ask({"command": "set_pose", "x_m": 1, "y_m": -2.5, "yaw_rad": 7.0})
        await until(lambda: bool(bench.taken))
        request, on_end = bench.taken[0]
        assert request.code is CommandCode.SET_POSE
        assert request.pose == pytest.approx((1.0, -2.5, 7.0 - 6.283185307))
        bench.server.publish(snapshot(pose=(1.0, 2.0, 3.0), map_id=0xAB))
        on_end(Outcome.DONE, "")
        on_end(Outcome.REFUSED, "a second end")
        said = json.loads(await closed(reader))
        writer.close()
    assert (said["schema"], said["command"], said["result"], said["reason"]) == (
        "lumiloop.command/1",
        "set_pose",
        "done",
        "",
    )
    assert said["pose"] == {"x_m": 1.0, "y_m": 2.0, "yaw_rad": 3.0}
    assert said["map_id"] == 0xAB
    assert not bench.server.path.exists()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (b"\n", "invalid request"),
        (b"\xff\xfe\n", "invalid request"),
        (b"[" * 1000 + b"\n", "invalid request"),
        ({"command": "fly"}, "unknown command 'fly'"),
        ({"command": "pause", "x_m": 1.0}, "x_m, y_m and yaw_rad are needed for set_pose"),
        ({"command": "set_pose", "x_m": 1.0, "y_m": 1.0}, "x_m, y_m and yaw_rad are needed for set_pose"),
        ({"command": "set_pose", "x_m": 1e9, "y_m": 0, "yaw_rad": 0}, "the pose is beyond"),
        (b'{"command": "set_pose", "x_m": 1e999, "y_m": 0, "yaw_rad": 0}\n', ""),
        ({"command": "switch_map"}, "map_id is needed for switch_map, and allowed"),
        ({"command": "switch_map", "map_id": -1}, "32 bits"),
        ({"command": "pause", "more": 1}, "invalid request"),
        (b"x" * (LONGEST_REQUEST + 1), "longer than"),
    ],
)
async def test_what_is_no_order_is_refused_with_the_reason(tmp_path: Path, line: object, reason: str) -> None:
    async with serving(tmp_path) as bench:
        said = await bench.answer(line)
        assert said["result"] in ("unknown", "refused")
        assert reason in said["reason"]
        assert said["reason"]
        assert bench.taken == []
        assert not bench.server.clients


async def test_only_user_and_group_may_connect(tmp_path: Path) -> None:
    async with serving(tmp_path) as bench:
        assert stat.S_IMODE(bench.server.path.stat().st_mode) == 0o660


async def test_clients_that_say_nothing_are_let_go_and_keep_nobody_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(command_socket, "REQUEST_S", 0.2)
    async with serving(tmp_path) as bench:
        silent = [await bench.ask(b"") for _ in range(CLIENTS)]
        await until(lambda: len(bench.server.clients) == CLIENTS)
        reader, writer = await bench.ask({"command": "pause"})
        await until(lambda: bool(bench.taken))
        assert len(bench.server.clients) == CLIENTS
        assert b"a newer client" in await closed(silent[0][0])
        assert b"no request arrived within" in await closed(silent[1][0])
        bench.taken[0][1](Outcome.DONE, "")
        assert b'"done"' in await closed(reader)
        for one in [(reader, writer), *silent]:
            one[1].close()
        await until(lambda: not bench.server.clients)


async def test_an_order_without_an_end_is_answered_in_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command_socket, "ANSWER_S", 0.05)
    async with serving(tmp_path) as bench:
        said = await bench.answer({"command": "relocalise"})
        assert (said["result"], said["reason"]) == ("running", "not finished after 0.05 s")


async def test_a_search_ends_when_the_place_is_confirmed(tmp_path: Path) -> None:
    """The order has been taken long before, and a pose that is a guess is no result."""
    async with serving(tmp_path) as bench:
        reader, writer = await bench.ask({"command": "relocalise"})
        await until(lambda: bool(bench.taken))
        for state in (State.RELOCATING, State.AMBIGUOUS):
            bench.server.publish(snapshot(state=state))
            bench.taken[0][1](Outcome.DONE, "")
        await asyncio.sleep(0.01)
        assert len(bench.server.clients) == 1
        bench.server.publish(snapshot(state=State.TRACKING))
        said = json.loads(await closed(reader))
        assert (said["result"], said["state"]) == ("done", "TRACKING")
        writer.close()


async def test_a_client_that_does_not_wait_harms_nothing(tmp_path: Path) -> None:
    async with serving(tmp_path) as bench:
        _, writer = await bench.ask({"command": "save_map"})
        await until(lambda: bool(bench.taken))
        writer.transport.abort()
        await asyncio.sleep(0.01)
        bench.taken[0][1](Outcome.DONE, "")
        await until(lambda: not bench.server.clients)


async def test_a_client_that_sends_no_more_gets_its_reply(tmp_path: Path) -> None:
    """As `nc -N` does."""
    async with serving(tmp_path) as bench:
        reader, writer = await bench.ask({"command": "pause"})
        writer.write_eof()
        await until(lambda: bool(bench.taken))
        bench.taken[0][1](Outcome.DONE, "")
        assert b'"done"' in await closed(reader)
        writer.close()
        reader, writer = await bench.ask(b"half a requ")
        writer.write_eof()
        assert await closed(reader) == b""
        writer.close()


async def test_more_after_an_order_is_not_taken(tmp_path: Path) -> None:
    """The order counts once, and what follows it does not grow in memory."""
    async with serving(tmp_path) as bench:
        reader, writer = await bench.ask(b'{"command": "pause"}\n' + b'{"command": "resume"}\n' * 5000)
        await until(lambda: bool(bench.taken))
        writer.write(b"x" * (1 << 20))
        await asyncio.sleep(0.05)
        assert len(bench.taken) == 1
        bench.taken[0][1](Outcome.DONE, "")
        await closed(reader)  # with unread data the kernel may drop the reply
        assert not bench.server.clients
        writer.close()


@pytest.fixture
def other(tmp_path: Path) -> Iterator[Path]:
    path = tmp_path / "agv.commands"
    with socket.socket(socket.AF_UNIX) as sock:
        sock.bind(str(path))
        sock.listen(1)
        yield path


def test_a_socket_of_another_program_is_left_alone(other: Path) -> None:
    with pytest.raises(DeviceRefused, match="another program serves it"):
        asyncio.run(CommandSocket(other, lambda *_: None).run())
    assert other.is_socket()


async def test_the_file_of_a_dead_program_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "agv.commands"
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))
    async with serving(tmp_path) as bench:
        said = await bench.answer({"command": "fly"})
        assert said["result"] == "unknown"
