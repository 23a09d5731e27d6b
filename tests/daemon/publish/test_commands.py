"""Orders over Modbus: who carries each out, and when its end is told."""

from __future__ import annotations

import logging
from typing import Any

import pytest

from daemon.publish.commands import ASKED, NO_RECORDER, Orders
from daemon.publish.feeds import Feeds
from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from daemon.system.callbacks import OnDone
from estimator.measurements import Command, Order
from tests.daemon.publish.modbus.test_registers import snapshot


class Clock:
    """Stands still until it is moved on."""

    t = 100.0

    def now(self) -> float:
        return self.t

    def utc(self) -> float:
        return self.t


class Bench:
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
    bench = Bench()
    bench.ask(7, CommandCode[order.name])
    assert [command.order for command in bench.commands] == [order]
    assert (bench.commands[0].T_map_base is not None) == (order is Order.SET_POSE)
    bench.orders.published(snapshot(pose=None))
    assert bench.ended == []
    bench.orders.published(snapshot())
    bench.orders.published(snapshot())
    assert bench.ended == [(7, Outcome.DONE)]


def test_a_pause_is_done_with_the_next_snapshot_pose_or_not() -> None:
    bench = Bench()
    bench.ask(3, CommandCode.PAUSE)
    bench.ask(4, CommandCode.RESUME)
    bench.ask(5, CommandCode.RESET)
    assert bench.ended == []
    bench.orders.published(snapshot(pose=None))
    assert [command.order for command in bench.commands] == [Order.PAUSE, Order.RESUME, Order.RESET]
    assert bench.ended == [(3, Outcome.DONE), (4, Outcome.DONE)]


def test_orders_that_wait_for_a_pose_do_not_pile_up() -> None:
    bench = Bench()
    for number in range(1, 1001):
        bench.ask(number, CommandCode.RELOCALISE)
    bench.orders.published(snapshot())
    assert len(bench.ended) == ASKED
    assert bench.ended[-1] == (1000, Outcome.DONE)


def test_orders_at_any_rate_do_not_fill_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """A controller that orders a hundred times a second for a minute, and is refused each time."""
    bench = Bench()
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
    bench = Bench(on_dump=dumps.append, on_switch=lambda map_id, told: switches.append((map_id, told)))
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
    bench = Bench()
    bench.ask(9, code)
    assert bench.ended == [(9, Outcome.REFUSED)]


def test_whatever_goes_wrong_with_an_order_its_client_hears_of_its_end(caplog: pytest.LogCaptureFixture) -> None:
    def broken(told: OnDone) -> None:
        raise MemoryError

    bench = Bench(on_dump=broken)
    bench.ask(5, CommandCode.DUMP_RECORDER)
    assert bench.ended == [(5, Outcome.REFUSED)]
    assert "DUMP_RECORDER refused: the command has failed: MemoryError()" in caplog.text
