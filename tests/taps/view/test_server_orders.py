"""Orders that browsers give the daemon: who may, and for which robot they are."""

import asyncio
import struct
import subprocess
import sys
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from daemon.config.paths import stream_path
from daemon.publish.modbus import command_client
from daemon.publish.modbus.command_client import CommandRefused, switch_map
from daemon.publish.modbus.holding import COMMAND_ADDRESS, CommandCode, Outcome, Request
from taps.access_guard import Guard
from taps.view.orders import Orders
from tests.daemon.publish.network import publishing
from tests.daemon.publish.stream.test_server import until
from tests.taps.view.house import TOKEN, House, Page, serving


async def order(page: Page, name: str, **other: object) -> None:
    await page.socket.send_json({"order": name, **other})


@asynccontextmanager
async def ordering(folder: Path, write: bool = True) -> AsyncIterator[tuple[House, list[Request], Any]]:
    """The page's server, the orders that come to the daemon, and the daemon's Modbus server."""
    asked: list[Request] = []
    async with (
        publishing(write=write, on_command=asked.append) as modbus,
        serving(folder, Guard("127.0.0.1", TOKEN, True), modbus=modbus.port) as house,
    ):
        yield house, asked, modbus


async def test_an_order_reaches_the_daemon_and_all_are_told(tmp_path: Path) -> None:
    async with ordering(tmp_path) as (house, asked, modbus), house.page(TOKEN) as page, house.page() as other:
        told = await page.welcome()
        assert set(told["orders"]) >= {"relocalise", "save_map", "set_pose", "dump_recorder"}
        assert (await other.welcome())["orders"] == {}
        await order(page, "set_pose", pose=[1.25, -2.5, 7.0])
        running = await other.until("order")
        assert (running["order"], running["outcome"], running["viewer"]) == ("set_pose", "running", told["you"])
        assert asked[0].code is CommandCode.SET_POSE
        assert asked[0].pose == pytest.approx((1.25, -2.5, 7.0 - 2 * np.pi), abs=1e-4)
        modbus.acknowledge(asked[0].number, Outcome.DONE)
        assert (await other.until("order"))["outcome"] == "done"
        assert (await page.until("order", lambda one: one["outcome"] == "done"))["number"] == asked[0].number


async def test_the_last_of_two_orders_wins_and_both_are_told(tmp_path: Path) -> None:
    async with ordering(tmp_path) as (house, asked, modbus), house.page(TOKEN) as page, house.page(TOKEN) as other:
        await page.welcome()
        second = (await other.welcome())["you"]
        await order(page, "save_map")
        await page.until("order")
        await order(other, "relocalise")
        replaced = await page.until("order", lambda one: one["outcome"] == "replaced")
        assert (replaced["order"], replaced["by"]) == ("save_map", second)
        await other.until("order", lambda one: one["outcome"] == "replaced")
        modbus.acknowledge(asked[1].number, Outcome.REFUSED)
        for one in (page, other):
            assert (await one.until("order", lambda o: o["outcome"] == "refused"))["order"] == "relocalise"


async def test_an_order_that_another_client_replaces(tmp_path: Path) -> None:
    async with ordering(tmp_path) as (house, _, modbus), house.page(TOKEN) as page:
        await page.welcome()
        await order(page, "relocalise")
        await page.until("order")
        machine = Orders("127.0.0.1", modbus.port, lambda told: None)
        try:
            await machine.give(0, {"order": "save_map"})
            assert "by" not in await page.until("order", lambda one: one["outcome"] == "replaced")
        finally:
            await machine.close()


async def test_the_end_of_another_client_s_order_of_the_same_number_is_not_ours(tmp_path: Path) -> None:
    """Two masters took the next number at the same moment: the later order is the one that is done."""
    async with ordering(tmp_path) as (house, asked, modbus), house.page(TOKEN) as page:
        await page.welcome()
        await order(page, "relocalise")
        await page.until("order")
        wire = await command_client.connect("127.0.0.1", modbus.port)
        try:
            other = struct.pack(">HH", asked[0].number, CommandCode.SAVE_MAP)
            await wire.request(struct.pack(">BHHB", 16, COMMAND_ADDRESS, 2, 4) + other)
            modbus.acknowledge(asked[0].number, Outcome.DONE)
            assert (await page.until("order", lambda one: one["outcome"] != "running"))["outcome"] == "replaced"
            taken = {await wire.next_number() for _ in range(40)}
            assert asked[0].number not in taken
            assert len(taken) > 30
            assert all(0 < number <= 0xFFFF for number in taken)
        finally:
            wire.close()


@pytest.mark.parametrize(("between", "said"), [(None, "done"), (0x78, "replaced")])
async def test_another_map_that_somebody_names_in_between_is_no_map_of_ours(
    tmp_path: Path, between: int | None, said: str
) -> None:
    async with ordering(tmp_path) as (_, asked, modbus):
        wire = await command_client.connect("127.0.0.1", modbus.port)
        switching = asyncio.create_task(command_client.switch_map("agv", "127.0.0.1", modbus.port, 0x77))
        try:
            await until(lambda: bool(asked))
            assert (asked[0].code, asked[0].map_id) == (CommandCode.SWITCH_MAP, 0x77)
            if between is not None:
                await wire.request(struct.pack(">BHHBI", 16, command_client.MAP_ADDRESS, 2, 4, between))
            modbus.acknowledge(asked[0].number, Outcome.DONE)
            assert await switching == said
        finally:
            wire.close()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ({"order": "reset"}, "unknown command"),
        ({"order": "set_pose"}, "set_pose needs x and y"),
        ({"order": "set_pose", "pose": [1, 2, "3"]}, "set_pose needs x and y"),
        ({"order": "set_pose", "pose": [1, 2, float("nan")]}, "set_pose needs x and y"),
        ({"order": "set_pose", "pose": [1e9, 2, 0]}, "away"),
        ({"order": "set_pose", "pose": [10**400, 2, 0]}, "set_pose needs x and y"),
        ({"order": ["x"]}, "unknown command"),
    ],
)
async def test_orders_that_cannot_be_given(tmp_path: Path, words: dict[str, Any], said: str) -> None:
    async with ordering(tmp_path) as (house, asked, _), house.page(TOKEN) as page:
        await page.welcome()
        await page.socket.send_json(words)
        assert said in (await page.until("order"))["outcome"]
        assert asked == []


async def test_a_daemon_that_takes_no_orders_says_so(tmp_path: Path) -> None:
    async with (
        ordering(tmp_path, write=False) as (house, asked, _modbus),
        house.page(TOKEN) as page,
        house.page() as other,
    ):
        for one in (page, other):
            await one.welcome()
            await order(one, "relocalise")
        assert "modbus.write = true" in (await page.until("order"))["outcome"]
        assert "--write" in (await other.until("order"))["outcome"]
        assert asked == []


async def test_a_daemon_without_modbus_takes_no_orders(tmp_path: Path) -> None:
    async with serving(tmp_path, guard=Guard("127.0.0.1", TOKEN, True)) as house, house.page(TOKEN) as page:
        await page.welcome()
        await order(page, "save_map")
        assert "modbus.port" in (await page.until("order"))["outcome"]


OTHER = """
import socket, sys
sock = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
sock.bind(("127.0.0.1", 0))
print(sock.getsockname()[1], flush=True)
while True:
    print(sock.recvfrom(512)[0].hex(), flush=True)
"""


@pytest.fixture
def other() -> Iterator[tuple[int, subprocess.Popen[str]]]:
    """A port of another process, which says what it is asked."""
    with subprocess.Popen([sys.executable, "-c", OTHER], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield int(process.stdout.readline()), process
        finally:
            process.kill()


async def test_another_daemon_is_not_ordered_about(tmp_path: Path, other: tuple[int, subprocess.Popen[str]]) -> None:
    """As where two run here and the page's configuration names the port of the wrong one."""
    port, process = other
    async with serving(tmp_path, Guard("127.0.0.1", TOKEN, True), modbus=port) as house, house.page(TOKEN) as page:
        await page.welcome()
        await page.socket.send_json({"order": "set_pose", "pose": [1.0, 2.0, 0.0]})
        said = (await page.until("order"))["outcome"]
    assert f"127.0.0.1:{port} belongs to process {process.pid}" in said
    assert "--config" in said
    process.kill()
    assert process.stdout is not None
    assert process.stdout.read() == "", "it was asked nothing"


async def test_nor_is_its_map_switched(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, other: tuple[int, subprocess.Popen[str]]
) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path))
    path = stream_path("agv")
    server = await asyncio.start_unix_server(lambda reader, writer: writer.close(), path)
    try:
        with pytest.raises(CommandRefused, match="name its configuration with --config, or give"):
            await switch_map("agv", "127.0.0.1", other[0], 1)
    finally:
        server.close()
