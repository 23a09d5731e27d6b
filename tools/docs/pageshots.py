"""``python -m tools.docs.pageshots``: the pictures of the web page in the documents, from a simulated robot's own page.

Needs chromium (`apt-get install chromium`). The robot drives under lamps for a while, and the page is photographed, as
a desktop and as a phone show it.
"""

import argparse
import asyncio
import sys
import tempfile
from pathlib import Path
from typing import Final

from PIL import Image

from tools.docs.browser import BrowserError, chromium, robot, tab, view

SEEN: Final = "globalThis.lumiloop && lumiloop.world.pose && lumiloop.world.pose.pose && lumiloop.world.lampsPlaced"
PICTURES: Final = ("view.png", "view-phone.png")
DESKTOP, PHONE = (1280, 860), (390, 844)
WELL: Final = 'lumiloop.world.pose.state_name === "TRACKING" && lumiloop.world.faults.length === 0'
"""A picture of a robot on a computer that was too slow just then shows nobody what to expect."""
PATIENCE_S: Final = 180.0
SETTLE_S: Final = 3.0


def smaller(path: Path) -> None:
    """The PNG at ``path`` with 256 colours, a third of its size; a page is flat, nobody sees the difference."""
    with Image.open(path) as image:
        few = image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
    few.save(path, optimize=True)


async def photograph(browser: str, address: str, out: Path, seconds: float) -> None:
    """Both pictures, after so many seconds of driving, of a robot that is TRACKING without a fault.

    Raises:
        BrowserError: it is not, for three minutes.
    """
    async with tab(browser, address, DESKTOP) as page:
        await page.until(SEEN, 60.0)
        await asyncio.sleep(seconds)
        await page.until(WELL, PATIENCE_S)
        await page.picture(out / PICTURES[0])
    async with tab(browser, address, PHONE, phone=True, dark=False) as page:
        await page.until(SEEN, 60.0)
        await asyncio.sleep(SETTLE_S)
        await page.until(WELL, PATIENCE_S)
        await page.picture(out / PICTURES[1])


def main() -> int:
    """Exit code 1 where there is no browser."""
    parser = argparse.ArgumentParser(prog="python -m tools.docs.pageshots", description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=40.0, help="of driving before (default %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("docs/images"), help="default: %(default)s")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="lumiloop-page-") as name:
        folder = Path(name)
        try:
            with (
                chromium(folder) as browser,
                robot(folder) as one,
                view(one.env, folder, "--config", str(one.config), "--write") as address,
            ):
                one.drive()
                asyncio.run(photograph(browser, address, options.out, options.seconds))
        except BrowserError as error:
            print(error, file=sys.stderr)
            return 1
    for picture in PICTURES:
        smaller(options.out / picture)
    print("written:", ", ".join(str(options.out / picture) for picture in PICTURES))
    return 0


if __name__ == "__main__":
    sys.exit(main())
