"""Where lamps hang and how the lidar sits: as the daemon that is watched has read it, not as an earlier one had."""

import asyncio
import logging
from pathlib import Path

import pytest

from daemon.config.survey_loader import write_survey
from estimator.light_filter.survey import Lamp, Survey
from taps.view.command import _scene
from taps.view.page_hello import Scene, SceneUnreadable
from tests.taps.view.house import House, serving
from tools.docs.browser import CHROMIUM, chromium, tab

BEFORE, AFTER = Scene("agv", lamps=[(1, 5, 0.0, 0.0)]), Scene("agv", (0.1, 0.0, 90.0, False), [(1, 5, 3.0, 4.0)])


def begins_anew(house: House) -> None:
    """The daemon."""
    for client in list(house.stream.clients):
        client.drop()


async def test_a_daemon_that_begins_with_another_survey(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    found: list[Scene | SceneUnreadable] = [BEFORE]

    def again() -> Scene:
        if isinstance(found[-1], SceneUnreadable):
            raise found[-1]
        return found[-1]

    caplog.set_level(logging.WARNING)
    async with serving(tmp_path, scene=BEFORE, again=again) as house, house.page() as page:
        assert (await page.welcome())["lamps"] == [[1, 5, 0.0, 0.0]]
        await page.until("daemon", lambda told: told["up"])
        found.append(AFTER)
        begins_anew(house)
        told = await page.until("scene")
        assert (told["lamps"], told["mount"]) == ([[1, 5, 3.0, 4.0]], [0.1, 0.0, 90.0, False])
        async with house.page() as other:
            assert (await other.welcome())["lamps"] == [[1, 5, 3.0, 4.0]]
        found.append(SceneUnreadable("lights.toml, line 3: lamp 7 twice"))
        begins_anew(house)
        await page.until("daemon", lambda told: told["up"])
        async with house.page() as other:
            assert (await other.welcome())["lamps"] == [[1, 5, 3.0, 4.0]]
    assert "the previous lamps and mount are shown: lights.toml, line 3: lamp 7 twice" in caplog.text


def test_what_is_read_is_the_files_as_they_are_now(tmp_path: Path) -> None:
    file, lights = tmp_path / "lumiloop.toml", tmp_path / "lights.toml"
    file.write_text('photodiode.bus = "/dev/i2c-1"\nlights.survey = "lights.toml"\nlidar.mount.x = 0.2\n')
    write_survey(lights, Survey((Lamp(7, 3, 1.0, 2.0, 2.6),)))
    assert _scene(file, ()).lamps == [(7, 3, 1.0, 2.0)]
    write_survey(lights, Survey((Lamp(7, 3, 5.0, 2.0, 2.6),)), force=True)
    again = _scene(file, ("lidar.mount.yaw=90.0",))
    assert (again.lamps, again.mount[0], again.mount[2]) == ([(7, 3, 5.0, 2.0)], 0.2, 90.0)
    lights.write_text("garbage")
    with pytest.raises(SceneUnreadable, match=r"lights\.toml"):
        _scene(file, ())
    file.write_text("nonsense = 1\n")
    with pytest.raises(SceneUnreadable, match="nonsense"):
        _scene(file, ())


@pytest.mark.system
@pytest.mark.skipif(CHROMIUM is None, reason="no chromium: apt-get install chromium")
def test_the_page_draws_the_new_lamps_and_keeps_the_name(tmp_path: Path) -> None:
    found = [BEFORE]

    async def body(browser: str) -> None:
        async with (
            serving(tmp_path, scene=BEFORE, again=lambda: found[-1]) as house,
            tab(browser, house.address) as page,
        ):
            await page.until("globalThis.lumiloop && lumiloop.world.scene.lamps.length === 1")
            found.append(AFTER)
            begins_anew(house)
            await page.until("lumiloop.world.scene.lamps[0][2] === 3")
            assert await page.js("document.getElementById('name').textContent") == "agv"

    (tmp_path / "browser").mkdir()
    with chromium(tmp_path / "browser") as browser:
        asyncio.run(body(browser))
