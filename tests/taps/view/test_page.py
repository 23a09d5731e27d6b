"""What the page shows and can do, in a real browser, at the sizes of a desktop and a phone, dark and light."""

import asyncio
import contextlib
import csv
import json
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any, Final

import pytest
from PIL import Image

from tests.taps.view.house import TOKEN
from tests.taps.view.robot_room import FAULTS, LAMPS, STREET, WIDTH, showing
from tools.docs.browser import CHROMIUM, Tab, chromium, tab

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
]
DESKTOP, PHONE = (1400, 900), (390, 844)
SHOWN: Final = "globalThis.lumiloop && lumiloop.world.pose && lumiloop.world.scan && lumiloop.world.rows.length > 1000"
UNREADABLE: Final = """(() => {
  const parse = (text) => {
    const n = text.match(/[\\d.]+/g).map(Number);
    const scale = text.startsWith("color(srgb") ? 255 : 1;
    return [scale * n[0], scale * n[1], scale * n[2], n[3] ?? 1];
  };
  const over = (a, b) => [0, 1, 2].map((k) => a[3] * a[k] + (1 - a[3]) * b[k]).concat(1);
  const light = (c) => [0.2126, 0.7152, 0.0722].reduce((sum, part, k) => {
    const v = c[k] / 255;
    return sum + part * (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
  }, 0);
  const found = [];
  let seen = 0;
  const walk = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const node = walk.currentNode, one = node.parentElement;
    if (!node.data.trim() || one.closest("noscript") || !one.checkVisibility({ opacityProperty: true })) continue;
    seen++;
    const layers = [];
    for (let at = one; at; at = at.parentElement) {
      layers.push(parse(getComputedStyle(at).backgroundColor));
      const fill = at.parentElement && at.parentElement.classList.contains("bar") && at.previousElementSibling;
      if (fill) layers.push(parse(getComputedStyle(fill).backgroundColor));
    }
    const ground = layers.reverse().reduce((below, layer) => over(layer, below), [255, 255, 255, 1]);
    const a = light(over(parse(getComputedStyle(one).color), ground)), b = light(ground);
    const ratio = (Math.max(a, b) + 0.05) / (Math.min(a, b) + 0.05);
    if (ratio < 4.5) found.push(`${node.data.trim().slice(0, 30)}: ${ratio.toFixed(2)}`);
  }
  return [seen, found];
})()"""
"""How many texts there are, and those whose contrast with what lies behind them is below 4.5, as laid out."""


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with chromium(tmp_path_factory.mktemp("browser")) as one:
        yield one


@contextlib.asynccontextmanager
async def look(browser: str, folder: Path, **options: Any) -> AsyncIterator[Tab]:
    """The page of the room; the browser has nothing to complain of."""
    async with (
        showing(folder) as house,
        tab(browser, f"{house.address}/#token={TOKEN}", **{"size": DESKTOP, **options}) as one,
    ):
        await one.until(SHOWN)
        await one.until("lumiloop.camera.scale !== 48 && document.querySelectorAll('.link').length > 4")
        yield one
        assert one.said == []


async def text(page: Tab, selector: str) -> str:
    return str(await page.js(f"document.querySelector({selector!r}).innerText"))


async def screen_of(page: Tab, x: float, y: float) -> tuple[float, float]:
    """Where a place of the map is in the view, pixels."""
    stage = "document.getElementById('stage').getBoundingClientRect()"
    left, top = await page.js(f"((b, at) => [b.x + at[0], b.y + at[1]])({stage}, lumiloop.camera.screen({x}, {y}))")
    return float(left), float(top)


async def point(page: Tab, x: float, y: float) -> None:
    """Move the mouse there."""
    await page.ask("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)


async def press(page: Tab, key: str) -> None:
    await page.js(f"document.body.dispatchEvent(new KeyboardEvent('keydown', {{key: {key!r}, bubbles: true}}))")


async def show_faults(page: Tab, faults: list[dict[str, object]], t: float = 701.0) -> None:
    await page.js(f"lumiloop.link.told.frame('faults', {json.dumps({'present': faults, 't_mono': t})})")


@pytest.mark.parametrize("dark", [True, False])
@pytest.mark.parametrize("size", [DESKTOP, PHONE])
async def test_every_text_can_be_read(browser: str, tmp_path: Path, size: tuple[int, int], dark: bool) -> None:
    async with look(browser, tmp_path, size=size, phone=size == PHONE, dark=dark) as page:
        await show_faults(page, FAULTS)
        await page.js(
            "for (const one of document.querySelectorAll('details')) one.open = true;"
            "if (document.getElementById('legend').hidden) document.getElementById('legend-open').click();"
            "document.querySelector('[data-layer=scan]').click(); document.querySelector('.link:not(.heads)').click();"
        )
        await page.until(
            "document.querySelectorAll('#bars .row').length > 2 && !document.getElementById('lamp').hidden"
        )
        seen, unreadable = await page.js(UNREADABLE)
        assert seen > 100
        assert unreadable == []
        await page.js("document.documentElement.style.setProperty('--dim', '#767b85')")
        assert (await page.js(UNREADABLE))[1] != []  # of what cannot be read it says so
        await page.js("document.documentElement.style.removeProperty('--dim')")
        for opener, dialog in (("#help", "keys"), ("[data-order=pause]", "confirm")):
            await page.js(f"document.querySelector({opener!r}).click()")
            assert (await page.js(UNREADABLE))[1] == []
            await page.js(f"document.getElementById({dialog!r}).close()")
        wide = await page.js("[document.documentElement.scrollWidth, innerWidth]")
        assert wide[0] <= wide[1]


async def test_the_state_is_seen_at_once(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path) as page:
        await page.until("document.title === 'TRACKING – agv-7 – lumiloop'")
        assert not await page.js("document.getElementById('card-cycle').open")
        listed = await text(page, "#legend")
        for word in ("free", "unknown", "TRACKING", "latest scan", "protection level", "loop closure", "occluded"):
            assert word in listed
        apart = "((a, b) => a.right <= b.left || a.bottom <= b.top || b.bottom <= a.top)"
        boxes = ", ".join(f"document.querySelector('{name}').getBoundingClientRect()" for name in (".legend", ".tools"))
        assert await page.js(f"{apart}({boxes})")  # nothing is covered
        assert (await text(page, "#dimmed")).split("\n") == ["PWM lamp of 15.0 kHz or 7.2 kHz", "5 µA"]
        heads = await page.js("[...document.querySelectorAll('.link.heads span')].map((one) => one.textContent)")
        assert heads == ["lamp", "use", "RSS", "residual"]
        await page.js("lumiloop.link.take = () => {}")
        await page.js("lumiloop.link.told.frame('daemon', {session: 1, up: false, why: 'the daemon has ended'})")
        await page.until("document.title.startsWith('NO DAEMON')")


async def test_on_a_phone_state_and_pose_come_first(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path, size=PHONE, phone=True) as page:
        top = {
            name: await page.js(f"document.getElementById({name!r}).getBoundingClientRect().top")
            for name in ("card-state", "card-pose", "stage", "card-orders")
        }
        assert list(top) == sorted(top, key=lambda name: top[name])
        assert top["stage"] < 0.55 * PHONE[1]
        await page.js("document.getElementById('legend-open').click()")
        inside = "(({left, right, top, bottom}) => [left, right, top, bottom])"
        legend = await page.js(f"{inside}(document.getElementById('legend').getBoundingClientRect())")
        tools = await page.js(f"{inside}(document.querySelector('.tools').getBoundingClientRect())")
        assert legend[1] <= tools[0]


async def test_the_view_is_where_the_robot_has_been(browser: str, tmp_path: Path) -> None:
    """Through the glass the lidar sees, and maps, four times as much street as there is room."""
    async with look(browser, tmp_path) as page:
        x0, _, x1, _ = await page.js("lumiloop.camera.seen()")
        assert x0 < 0.0
        assert WIDTH < x1 < STREET - 10.0
        await page.js("lumiloop.camera.zoom(0.1)")
        await press(page, "0")
        await page.until(f"lumiloop.camera.seen()[2] < {STREET - 10.0}")


async def test_relocalise_and_pause_ask_first(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path) as page:
        for order, word in (("relocalise", "Relocalise"), ("pause", "Pause")):
            await page.click(f"[data-order={order}]")
            assert await page.js("document.getElementById('confirm').open")
            await page.click("#confirm [value=no]")
            assert word not in await text(page, "#told")
            await page.click(f"[data-order={order}]")
            await page.click("#confirm-yes")
            await page.until(f"document.getElementById('told').textContent.includes({word!r})")
        await page.click("[data-order=save_map]")  # nothing is lost by this one
        await page.until("document.getElementById('told').textContent.includes('Save map')")


async def test_consequences_are_folded_below_their_cause(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path) as page:
        await show_faults(page, FAULTS)
        await page.until("document.querySelectorAll('#faults > li').length === 2")
        causes = await page.js(
            "[...document.querySelectorAll('#faults > li > b')].map((one) => one.textContent.trim())"
        )
        assert causes == ["231", "171"]
        assert "102" not in await text(page, "#faults")
        await page.click("#faults summary")
        await show_faults(page, FAULTS[:3], 702.0)
        await page.until("document.querySelectorAll('#faults > li').length === 1")
        opened = await text(page, "#faults details")  # it stays open
        assert "2 consequences" in opened
        assert opened.index("102") < opened.index("233")
        await page.until("document.getElementById('events').innerText.includes('Fault 171 cleared')")
        await show_faults(page, [{key: one[key] for key in ("fault", "meaning", "remedy")} for one in FAULTS], 703.0)
        await page.until("document.querySelectorAll('#faults > li').length >= 3")  # of a daemon that gives no causes


async def test_events_are_listed_with_their_times(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path) as page:
        rows = (await text(page, "#events")).splitlines()
        states = [row for row in rows if row in ("MAPPING", "TRACKING", "DEGRADED")]
        assert states == ["TRACKING", "DEGRADED", "TRACKING", "MAPPING"]  # of before the page was opened; latest first
        assert any("keyframe 120 to 3" in row for row in rows)
        apart = await page.js(
            "((all) => all.find((e) => e.text === 'DEGRADED').t - all.find((e) => e.text === 'MAPPING').t)"
            "(lumiloop.events.all)"
        )
        assert 295.0 < apart < 305.0


async def test_plots_give_the_value_at_the_pointer(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path) as page:
        await page.js("document.querySelector('.plot canvas').scrollIntoView({block: 'center'})")
        box = await page.js(
            "(({x, y, width, height}) => [x, y, width, height])"
            "(document.querySelector('.plot canvas').getBoundingClientRect())"
        )
        latest = await text(page, ".plot .value:last-child b")
        await point(page, box[0] + 0.5 * box[2], box[1] + 20.0)
        await page.until("lumiloop.plots.cursor !== null")
        await page.until(f"document.querySelector('.plot .value:last-child b').innerText !== {latest!r}")
        row = await page.js("lumiloop.plots.row()")
        assert await text(page, ".plot .value:last-child b") == f"{100.0 * row[5]:.1f} cm"
        ahead = await page.js("document.querySelector('.plot canvas').getAttribute('aria-label')")
        assert ahead.startswith("−5:")
        await point(page, box[0] - 300.0, box[1])
        await page.until("lumiloop.plots.cursor === null")


async def test_pointer_ruler_and_lamp(browser: str, tmp_path: Path) -> None:
    async with look(browser, tmp_path) as page:
        await point(page, *await screen_of(page, 1.0, 6.0))
        await page.until("document.getElementById('at').textContent === 'x 1.00, y 6.00 m'")
        lamp, code, x, y = LAMPS[2]
        await page.drag([await screen_of(page, x, y)])
        assert f"Lamp {lamp}".upper() in (await text(page, "#lamp")).upper()
        assert f"{x:.2f}, {y:.2f} m" in await text(page, "#lamp")
        assert str(code) in await text(page, "#lamp")
        await press(page, "r")
        await page.drag(
            [await screen_of(page, 1.0, 1.0), await screen_of(page, 2.0, 3.0), await screen_of(page, 4.0, 5.0)]
        )
        length = await page.js("(({from, to}) => Math.hypot(to[0] - from[0], to[1] - from[1]))(lumiloop.camera.aim)")
        assert length == pytest.approx(5.0, abs=0.05)
        await press(page, "Escape")
        assert await page.js("lumiloop.camera.mode === 'move' && document.getElementById('lamp').hidden")
        await press(page, "?")
        assert "ruler" in await text(page, "#keys")


async def test_picture_and_values_are_saved(browser: str, tmp_path: Path) -> None:
    got = tmp_path / "got"
    got.mkdir()

    async def arrived(pattern: str) -> Path:
        for _ in range(100):
            if found := [one for one in got.glob(pattern) if one.stat().st_size]:
                return found[0]
            await asyncio.sleep(0.1)
        raise AssertionError(f"{pattern} has not arrived: {list(got.iterdir())}")

    async with look(browser, tmp_path) as page:
        await page.ask("Page.setDownloadBehavior", behavior="allow", downloadPath=str(got))
        await press(page, "s")
        with Image.open(await arrived("lumiloop-agv-7-*.png")) as image:
            width = await page.js("document.getElementById('base').width")
            assert image.size[0] == width
            assert len(image.convert("RGB").getcolors(1 << 20) or []) > 20
        await press(page, "c")
        with (await arrived("lumiloop-agv-7-*[0-9Z].csv")).open() as file:
            rows = list(csv.DictReader(file))
        assert len(rows) > 1000
        assert {row["state"] for row in rows} == {"MAPPING", "DEGRADED", "TRACKING"}
        assert 0.04 < float(rows[-1]["protection_level_m"]) < 0.12
        await page.click("#events-csv")
        assert "TRACKING" in (await arrived("*-events.csv")).read_text()


async def test_a_page_of_a_robot_that_stands_rests(browser: str, tmp_path: Path) -> None:
    """Without new data there is nothing to draw, but for the clock's sake once a second."""
    async with look(browser, tmp_path) as page:
        await page.js("lumiloop.link.take = () => {}")
        await asyncio.sleep(1.0)
        await page.js(
            "globalThis.drawn = 0; const above = lumiloop.painter.above;"
            "lumiloop.painter.above = (...now) => { drawn += 1; return above.apply(lumiloop.painter, now); }; 0"
        )
        await asyncio.sleep(2.0)
        assert 1 <= await page.js("drawn") <= 8
