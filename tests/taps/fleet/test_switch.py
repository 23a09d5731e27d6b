"""A daemon is asked to go on in a map that was fetched: over its own Modbus server, as any client asks."""

from __future__ import annotations

import asyncio

import pytest

pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")

from daemon.publish.holding import CommandCode, Outcome, Request
from taps.fleet.fetch import switched
from tests.daemon.publish.network import publishing
from tests.taps.routers import free_port, until


@pytest.mark.parametrize(
    ("outcome", "said"),
    [
        (Outcome.DONE, "the daemon goes on in it"),
        (Outcome.REFUSED, "asked to go on in it: refused; its log says why"),
    ],
)
def test_the_map_that_was_fetched_is_asked_for(outcome: Outcome, said: str) -> None:
    async def run() -> str:
        asked: list[Request] = []
        async with publishing(write=True, on_command=asked.append) as modbus:
            asking = asyncio.ensure_future(switched(("127.0.0.1", modbus.port), 0x89ABCDEF))
            await until(lambda: asked)
            assert (asked[0].code, asked[0].map_id) == (CommandCode.SWITCH_MAP, 0x89ABCDEF)
            modbus.acknowledge(asked[0].number, outcome)
            return await asking

    assert said in asyncio.run(run())


def test_a_daemon_that_takes_no_orders_or_is_not_there_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    async def refused() -> str:
        async with publishing(write=False) as modbus:
            return await switched(("127.0.0.1", modbus.port), 1)

    assert "set `modbus.write = true`" in asyncio.run(refused())
    monkeypatch.setattr("taps.view.orders.TRY_S", 0.05)
    assert "does not answer" in asyncio.run(switched(("127.0.0.1", free_port()), 1))
