"""The page and its server where the connection between them is at fault: chromium, over a wire that can be cut."""

import asyncio
import contextlib
import zlib
from collections.abc import AsyncIterator, Iterator
from pathlib import Path

import pytest

from daemon.publish.stream.messages import MapTiles
from taps.access_guard import Guard
from taps.view import server
from tests.taps.view.house import TOKEN, House, serving, snapshot
from tools.docs.browser import CHROMIUM, Tab, chromium, tab

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
]
BANNER = "document.getElementById('banner').hidden ? '' : document.getElementById('banner').textContent"
POSE = "globalThis.lumiloop && lumiloop.world.pose && lumiloop.world.pose.seq"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with chromium(tmp_path_factory.mktemp("browser")) as one:
        yield one


class Wire:
    """Between browser and server. cut: nothing passes, and nobody is told, as where a radio link fades."""

    def __init__(self, address: str) -> None:
        host, port = address.removeprefix("http://").split(":")
        self._to = host, int(port)
        self.cut = False
        self._parts: list[asyncio.Task[None]] = []
        self._ends: list[asyncio.StreamWriter] = []

    async def meet(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._ends.append(writer)
        if self.cut:
            writer.close()
            return
        there, back = await asyncio.open_connection(*self._to)
        self._ends.append(back)
        self._parts += [asyncio.create_task(self._pass(*ends)) for ends in ((reader, back), (there, writer))]

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        dead = False
        with contextlib.suppress(ConnectionError):
            while data := await reader.read(1 << 16):
                dead = dead or self.cut
                if not dead:
                    writer.write(data)
            if not dead:
                writer.close()

    async def end(self) -> None:
        for part in self._parts:
            part.cancel()
        await asyncio.gather(*self._parts, return_exceptions=True)
        for writer in self._ends:
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()


@contextlib.asynccontextmanager
async def wired(house: House) -> AsyncIterator[tuple[Wire, str]]:
    wire = Wire(house.address)
    listening = await asyncio.start_server(wire.meet, "127.0.0.1", 0)
    try:
        yield wire, f"http://127.0.0.1:{listening.sockets[0].getsockname()[1]}"
    finally:
        listening.close()
        await wire.end()


async def shows(page: Tab, text: str, seconds: float = 20.0) -> None:
    await page.until(f"({BANNER}).includes({text!r})", seconds)


async def test_a_dead_wire_is_no_daemon_that_stands_and_the_page_comes_back(browser: str, tmp_path: Path) -> None:
    async with (
        serving(tmp_path, guard=Guard("127.0.0.1", TOKEN, True)) as house,
        wired(house) as (wire, address),
        tab(browser, f"{address}/#token={TOKEN}") as page,
    ):
        await page.until("globalThis.lumiloop")
        house.stream.publish(snapshot(1))
        await page.until(f"{POSE} === 1")
        wire.cut = True
        await page.click("[data-order=relocalise]")
        await page.click("#confirm-yes")  # into a wire that takes it
        await page.js(f"globalThis.told = []; setInterval(() => told.push({BANNER}), 50); 0")
        await shows(page, "No connection to the page")
        assert not [text for text in await page.js("told") if "the daemon does not respond" in text]
        await page.until("document.getElementById('state-name').textContent === 'NO SERVER'")
        await page.until("document.getElementById('told').textContent.includes('connection lost')")
        await page.click("[data-order=save_map]")
        await page.until(
            "[...document.querySelectorAll('#told li')].some((one) =>"
            "one.textContent.includes('Save map (you): not sent, no connection'))"
        )
        wire.cut = False
        house.stream.publish(snapshot(2))
        await page.until(f"{POSE} === 2")
        await page.until(f"({BANNER}) === ''")


async def test_a_browser_that_cannot_draw_the_map_says_so(browser: str, tmp_path: Path) -> None:
    """A phone of 2022 had shown everything but the map, and no word of why."""

    async with serving(tmp_path) as house, tab(browser, house.address) as page:
        await page.ask("Page.addScriptToEvaluateOnNewDocument", source="delete globalThis.DecompressionStream")
        await page.ask("Page.reload")
        await page.until("!('DecompressionStream' in globalThis) && globalThis.lumiloop")
        await shows(page, "too old to draw the map")
        tiles = MapTiles(
            map_id=7, resolution=0.05, side=128, unit=0.1, version=1, more=False,
            tiles=((0, 0, zlib.compress(bytes([20]) * 128 * 128)),),
        )  # fmt: skip
        house.view.hub.distribute(tiles)
        house.stream.publish(snapshot(1))
        await page.until(f"{POSE} === 1")
        assert page.said == []


async def test_a_daemon_that_stands_is_still_named(browser: str, tmp_path: Path) -> None:
    async with serving(tmp_path) as house, tab(browser, house.address) as page:
        await page.until("globalThis.lumiloop")
        house.stream.publish(snapshot(1))
        await page.until(f"{POSE} === 1")
        await shows(page, "the daemon does not respond")


async def test_who_closes_the_question_for_a_token_is_told_why_nothing_is_shown_and_is_asked_again(
    browser: str, tmp_path: Path
) -> None:
    async with serving(tmp_path, guard=Guard("0.0.0.0", TOKEN)) as house, tab(browser, house.address) as page:
        await page.until("globalThis.lumiloop")
        await page.until("document.getElementById('token').open")
        await page.until("document.getElementById('state-name').textContent === 'NO TOKEN'")
        assert "trying again" not in await page.js("document.body.innerText")
        await page.js("document.getElementById('token').close()")  # as Escape does
        await shows(page, "needs a token")
        await page.click("#banner")
        await page.until("document.getElementById('token').open")
        await page.js(f"document.getElementById('token-text').value = '{TOKEN}'; 0")
        await page.click("#token .go")
        house.stream.publish(snapshot(1))
        await page.until(f"{POSE} === 1")
        await page.until(f"({BANNER}) === ''")


async def test_a_browser_too_many_comes_in_when_another_goes(
    browser: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(server, "VIEWERS", 1)

    async with serving(tmp_path) as house, house.page() as first:
        await first.welcome()
        async with tab(browser, house.address) as page:
            await page.until("globalThis.lumiloop")
            await shows(page, "from one computer; close one. Trying again.")
            await first.socket.close()
            house.stream.publish(snapshot(1))
            await page.until(f"{POSE} === 1", 20.0)
            await page.until(f"({BANNER}) === ''")
