"""``python -m tools.docs.planshot``: picture and figures of the example in docs/planning.md.

The floor is a hall of 30 m x 18 m with nothing in it but a pillar, and a corridor that leads off it.
"""

import argparse
import contextlib
import io
import re
import shutil
import sys
import tempfile
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.cli import parser as cli_parser
from daemon.system import console
from tools.docs.pageshots import smaller

RESOLUTION_M: Final = 0.05
FREE, WALL, UNKNOWN = 254, 0, 205
SAMPLE: Final = re.compile(r"(?:^    .*\n)+(?=\n!\[A hall of)", re.MULTILINE)
"""What the command has said, on the page."""


def floor() -> npt.NDArray[np.uint8]:
    """The plan as a picture, rows from above."""
    cells = np.full((400, 800), UNKNOWN, np.uint8)

    def fill(x: tuple[float, float], y: tuple[float, float], grey: int) -> None:
        (left, right), (below, above) = ((round(a / RESOLUTION_M), round(b / RESOLUTION_M)) for a, b in (x, y))
        cells[below:above, left:right] = grey

    fill((0.9, 31.1), (0.9, 19.1), WALL)
    fill((31.0, 39.5), (8.9, 11.1), WALL)
    fill((1.0, 31.0), (1.0, 19.0), FREE)
    fill((31.0, 39.5), (9.0, 11.0), FREE)
    fill((10.0, 10.5), (5.0, 5.5), WALL)
    return cells[::-1]


def write_floor(folder: Path) -> Path:
    """``map.pgm`` with its YAML beside it, as map_server has them."""
    grey = floor()
    path = folder / "map.pgm"
    path.write_bytes(f"P5\n{grey.shape[1]} {grey.shape[0]}\n255\n".encode() + grey.tobytes())
    text = f"image: map.pgm\nresolution: {RESOLUTION_M}\norigin: [0.0, 0.0, 0.0]\nnegate: 0\n"
    path.with_suffix(".yaml").write_text(f"{text}occupied_thresh: 0.65\nfree_thresh: 0.196\n")
    return path


def shown(page: str, said: list[str]) -> str:
    """The page with what the command has said now.

    Raises:
        ValueError: the page has no such example.
    """
    page, found = SAMPLE.subn("".join(f"    {line}\n" for line in said), page)
    if found != 1:
        raise ValueError("the page has no example before its picture of a hall")
    return page


def main(arguments: list[str] | None = None) -> int:
    """Exit code of the planning; nothing is written where it fails."""
    parser = argparse.ArgumentParser(prog="python -m tools.docs.planshot", description=__doc__.splitlines()[0])
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="default: %(default)s")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="lumiloop-plan-") as name:
        folder, said = Path(name), io.StringIO()
        with contextlib.redirect_stdout(said):
            code = cli_parser.main(["plan", str(write_floor(folder)), "--out", str(folder / "plan")])
        if code != console.OK:
            return code
        told = [line for line in said.getvalue().splitlines() if line and str(folder) not in line]
        page = options.docs / "planning.md"
        page.write_text(shown(page.read_text(), told))
        shutil.copyfile(folder / "plan" / "plan.png", options.docs / "images" / "plan.png")
        smaller(options.docs / "images" / "plan.png")
    print("\n".join(told))
    return console.OK


if __name__ == "__main__":
    sys.exit(main())
