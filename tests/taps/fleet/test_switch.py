"""A daemon is asked to go on in a map that was fetched: over its own Modbus server, as any client asks."""

import asyncio

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")

from daemon.publish.modbus.holding import CommandCode, Outcome, Request
from taps.fleet.fetch import switched
from taps.fleet.placing import Refused
from tests.daemon.publish.network import publishing
from tests.taps.routers import until
from tools.sim.ports import free_port


def ask(outcome: Outcome) -> None:
    async def run() -> None:
        asked: list[Request] = []
        async with publishing(write=True, on_command=asked.append) as modbus:
            asking = asyncio.ensure_future(switched("agv", ("127.0.0.1", modbus.port), 0x89ABCDEF))
            await until(lambda: asked)
            assert (asked[0].code, asked[0].map_id) == (CommandCode.SWITCH_MAP, 0x89ABCDEF)
            modbus.acknowledge(asked[0].number, outcome)
            await asking

    asyncio.run(run())


def test_the_map_that_was_fetched_is_asked_for() -> None:
    ask(Outcome.DONE)


def test_a_daemon_that_does_not_go_on_in_it_is_a_failure() -> None:
    with pytest.raises(Refused, match="did not switch to the map: refused; its log gives the cause"):
        ask(Outcome.REFUSED)


def test_a_daemon_that_takes_no_orders_or_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    async def refused() -> None:
        async with publishing(write=False) as modbus:
            await switched("agv", ("127.0.0.1", modbus.port), 1)

    with pytest.raises(Refused, match=r"set `modbus\.write = true`"):
        asyncio.run(refused())
    monkeypatch.setattr("daemon.publish.modbus.command_client.ATTEMPT_S", 0.05)
    with pytest.raises(Refused, match="does not answer"):
        asyncio.run(switched("agv", ("127.0.0.1", free_port()), 1))
