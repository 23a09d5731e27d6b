"""The page in a real browser: Debian's chromium, over the protocol of its developer tools, on a simulated robot."""

import contextlib
import os
import sys
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest

from tools.docs.browser import CHROMIUM, Robot, Tab, chromium, robot, tab, view

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium"),
]
POSE = "globalThis.lumiloop && lumiloop.world.pose && lumiloop.world.pose.pose"
PHONE = (390, 844)
NARROWEST, TABLET = 320, 768
SLOW = """Promise.all([import("./panel.js"), import("./cycle.js")]).then(([{Panel}, {Cycle}]) => {
    document.getElementById("card-cycle").open = true;
    const pose = {pose: [0, 0, 0], covariance: null, known: [true, true, true], state: 3, map_id: 1, jumps: 0};
    const panel = new Panel({pose: {...pose, velocity: [0, 0, -0.001]}});
    panel.pose();
    new Cycle({}).bars([["cycle", [105750, 151200, 200000], "total"]], 50000);
    const figures = document.querySelector(".bars .row.total span:last-child");
    return [Math.round(figures.offsetHeight / parseFloat(getComputedStyle(figures).lineHeight)),
            document.getElementById("speed").textContent];
})"""
"""How many lines the figures of a cycle take that is slow, and how fast a robot is said to be that hardly turns."""
HEAD = """(() => {
  scrollTo(0, 0);
  document.getElementById("state-name").textContent = "RELOCATING";  // the longest
  const name = document.getElementById("name"), inside = ({ left, right, top, width }) =>
    width > 20 && left >= 0 && right <= innerWidth && top >= 0;
  const all = [name, ...document.querySelectorAll("header .chip, header .tag, header .round")];
  return [
    name.textContent, all.every((one) => inside(one.getBoundingClientRect())), name.scrollWidth - name.clientWidth,
    document.querySelector("header").getBoundingClientRect().bottom,
    parseFloat(getComputedStyle(document.documentElement).scrollPaddingTop),
  ];
})()"""
"""The robot's name, whether all of the head is in view, what is cut off of the name, where head ends, what it hides."""
FIRST_PAINT_MS, SHOWN_MS = 1000.0, 150.0
SLACK = 4.0
"""Of times that are measured on a machine that others use."""


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """A robot that drives, whose daemon takes orders."""
    with robot(tmp_path_factory.mktemp("robot")) as one:
        one.drive()
        yield one


@pytest.fixture(scope="module")
def address(driven: Robot) -> Iterator[str]:
    with view(driven.env, driven.folder, "--config", str(driven.config), "--write") as one:
        yield one


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with chromium(tmp_path_factory.mktemp("browser")) as one:
        yield one


@contextlib.asynccontextmanager
async def look(browser: str, address: str, **options: Any) -> AsyncIterator[Tab]:
    """The page with a pose; the browser has nothing to complain of."""
    async with tab(browser, address, **options) as page:
        await page.until(POSE, 60.0)
        yield page
        assert page.said == []


async def shown(page: Tab, name: str) -> Any:
    return await page.js(f"document.getElementById({name!r}).textContent")


async def test_the_page_loads_and_the_pose_moves(browser: str, address: str) -> None:
    async with look(browser, address) as page:
        first = await page.js("lumiloop.world.pose.pose")
        await page.until(
            f"Math.hypot(lumiloop.world.pose.pose[0] - {first[0]}, lumiloop.world.pose.pose[1] - {first[1]}) > 0.3"
        )
        await page.until("[...lumiloop.world.tiles.all.values()].some((tile) => tile.picture)")
        await page.until("lumiloop.world.points() && lumiloop.world.points().length > 400")
        await page.js("document.getElementById('card-cycle').open = true")
        await page.until(
            "document.querySelectorAll('.link').length >= 4 && document.querySelectorAll('.bars .row').length >= 5"
        )
        for name in ("x", "y", "yaw", "sx"):
            assert any(letter.isdigit() for letter in await shown(page, name)), name
        assert await page.js("location.hash") == ""  # the token is not left in the address
        await page.until("lumiloop.late.length >= 100")
        paint = await page.js("performance.getEntriesByType('paint')[0].startTime")
        late = await page.js("[...lumiloop.late].sort((a, b) => a - b)")
    sys.stdout.write(f"first paint {paint} ms, scan to screen {late[len(late) // 2]} ms (median)\n")
    assert paint < SLACK * FIRST_PAINT_MS
    assert 0.0 < late[len(late) // 2] < SLACK * SHOWN_MS


async def test_a_click_relocalises_and_who_only_looks_sees_it(browser: str, address: str) -> None:
    async with look(browser, address) as page, tab(browser, address.partition("#")[0]) as other:
        await other.until(POSE)
        assert await other.js("document.getElementById('card-orders').hidden")
        await page.js("globalThis.seen = []; lumiloop.world.on_state = (told) => seen.push(told.state_name)")
        await page.click("[data-order=relocalise]")
        await page.click("#confirm-yes")
        await page.until("document.querySelector('#told li')")
        # where several places fit by the time that it is told, it says so at once
        await page.until("seen.includes('RELOCATING') || seen.includes('AMBIGUOUS')", 60.0)
        await other.until("[...document.querySelectorAll('#told li')].length >= 1 || document.querySelector('.toast')")
        await page.until("document.querySelector('#told .done')", 60.0)


async def test_a_pose_is_set_by_dragging(browser: str, address: str) -> None:
    async with look(browser, address) as page:
        await page.click("[data-order=set_pose]")
        where, ahead = await page.js(
            "(() => { const b = document.getElementById('stage').getBoundingClientRect(), c = lumiloop.camera,"
            "p = lumiloop.world.pose.pose, at = c.screen(p[0], p[1]),"
            "to = c.screen(p[0] + Math.cos(p[2]), p[1] + Math.sin(p[2]));"
            "return [[b.x + at[0], b.y + at[1]], [b.x + to[0], b.y + to[1]]]; })()"
        )
        await page.drag([tuple(where), tuple(ahead)])
        await page.until("!document.getElementById('ask-yes').hidden")
        await page.click("#ask-yes")
        await page.until("document.querySelector('#told .done')", 30.0)
        assert await page.js("document.getElementById('ask').hidden")


async def test_a_phone(browser: str, address: str) -> None:
    async with look(browser, address, size=PHONE, phone=True) as page:
        wide = await page.js("[document.documentElement.scrollWidth, innerWidth]")
        assert wide[0] <= wide[1]  # nothing to be moved aside
        box = await page.js(
            "(({width, height}) => [width, height])(document.getElementById('stage').getBoundingClientRect())"
        )
        assert 0.9 * PHONE[0] < box[0] <= PHONE[0]
        assert 0.3 * PHONE[1] < box[1] < 0.7 * PHONE[1]
        small = await page.js(
            "[...document.querySelectorAll('header button, .tools button, [data-order]')].filter((e) => e.offsetParent)"
            ".filter((e) => e.getBoundingClientRect().height < 32).map((e) => e.outerHTML)"
        )
        assert small == []  # a finger finds them
        edge = await page.js("document.getElementById('theme').getBoundingClientRect().right")
        assert edge <= PHONE[0]
        lines, speed = await page.js(SLOW)
        assert lines == 1  # of a slow cycle's figures
        assert speed == "0.00 m/s, 0°/s"
        await page.click("[data-order=save_map]")  # not behind the map, which stays where it is
        await page.until("document.getElementById('told').textContent.includes('map')")
        for width in (PHONE[0], NARROWEST, TABLET):
            await page.ask(
                "Emulation.setDeviceMetricsOverride", width=width, height=700, deviceScaleFactor=2, mobile=True
            )
            name, within, cut, end, below = await page.js(HEAD)
            assert name.startswith("demo-")  # which of several robots this is
            assert within, width
            assert cut <= 0
            assert end <= below  # what gets the focus is not behind the head


async def test_an_old_tab_on_another_version_loads_itself_anew(browser: str, address: str) -> None:
    async with look(browser, address) as page:
        await page.js("globalThis.mark = 1")
        await page.js("lumiloop.link.page = 'of-last-year'; lumiloop.link.socket.close()")
        await page.until("document.getElementById('banner').textContent.includes('another version')")
        await page.until(f"globalThis.mark === undefined && {POSE}")


async def test_without_the_right_token_a_page_only_looks(browser: str, address: str) -> None:
    async with look(browser, address.partition("#")[0] + "#token=not-the-right-one") as page:
        for number in range(9):  # in a building that the robot knows by heart
            loop = f"{{counter: {number}, keyframe_new: {number}, keyframe_old: 0, residual: 0.01, reason: 0}}"
            await page.js(f"lumiloop.link.told.frame('loop', {loop})")
        said = await page.js("[...document.querySelectorAll('.toast')].map((one) => one.textContent)")
        assert "Wrong token. The page is read-only." in said
        assert len(said) == 3
        assert await page.js("document.getElementById('card-orders').hidden")
        assert await shown(page, "mode") == "read-only"


async def test_a_token_that_is_pasted_after_a_refusal_is_tried(browser: str, address: str) -> None:
    async with look(browser, address.partition("#")[0]) as page:
        await page.js("lumiloop.link.refused = 'token'; lumiloop.link.socket.close()")
        await page.until("lumiloop.link.socket === null")
        await page.js(f"location.hash = {address.partition('#')[2]!r}")
        await page.until("lumiloop.link.socket && document.getElementById('mode').textContent === 'control'", 20.0)


async def test_a_connection_that_answers_no_more_is_opened_again_and_orders_are_not_lost_unsaid(
    browser: str, address: str
) -> None:
    """A phone that leaves the network gets no word of it for minutes."""
    async with look(browser, address) as page:
        await page.js("globalThis.first = lumiloop.link.socket; first.onmessage = null")
        for _ in range(3):
            await page.js("lumiloop.link.ping()")
        await page.until("lumiloop.link.socket !== first")
        await page.js("document.querySelector('[data-order=save_map]').click()")
        said = await page.js("document.getElementById('toasts').textContent")
        assert "not sent, no connection" in said
        await page.js("globalThis.before = lumiloop.world.pose.seq")
        await page.until("lumiloop.link.socket && lumiloop.world.pose && lumiloop.world.pose.seq !== before")
        await page.until("document.getElementById('banner').hidden")


async def test_the_daemon_is_gone_and_the_page_says_so(browser: str, tmp_path: Path) -> None:
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    with view(env, tmp_path) as address:
        async with tab(browser, address) as page:
            await page.until("globalThis.lumiloop")
            await page.until("document.getElementById('banner').textContent.includes('start `lumiloop run`')")
            await page.until("document.getElementById('state-name').textContent === 'NO DAEMON'")
            assert page.said == []
        async with tab(browser, address, PHONE, phone=True) as page:  # the name of a socket is long, and has no gaps
            await page.until("globalThis.lumiloop")
            await page.until("document.getElementById('banner').textContent.includes('start `lumiloop run`')")
            beside = await page.js(
                "[document.getElementById('banner'), document.querySelector('.tools')].map((one) => ["
                "one.scrollWidth - one.clientWidth, one.getBoundingClientRect().left,"
                "one.getBoundingClientRect().right])"
            )
            assert beside[0][0] <= 0
            assert beside[0][2] <= beside[1][1]


async def test_a_recording_has_a_time_bar(browser: str, recording: Path, tmp_path: Path) -> None:
    with view(dict(os.environ), tmp_path, str(recording)) as address:
        async with look(browser, address) as page:
            await page.until("!document.getElementById('timebar').hidden")
            await page.until(
                "Number(document.getElementById('seek').max) - Number(document.getElementById('seek').min) > 7"
            )
            await page.click("#play")
            await page.until(
                "document.getElementById('play').querySelector('path').getAttribute('d').includes('l12 7')"
            )
            before = await page.js("lumiloop.world.pose.t_mono")
            await page.click("#seek")  # its middle
            await page.until(f"lumiloop.world.pose && Math.abs(lumiloop.world.pose.t_mono - {before}) > 0.5")
            assert await page.js("document.getElementById('card-orders').hidden")
