"""Animation of a drive: published pose and true robot on the map, lamps in use, state and reason, as a GIF."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from daemon.health.reasons import REASONS, Reason
from daemon.snapshot import State

Pose = tuple[float, float, float]
Colour = tuple[int, int, int]

SIDE: Final = 560
"""Pixels of the map's longer side."""
HEAD: Final = 92
FOOT: Final = 34
_FINE: Final = 2
"""Drawn so much larger first, for smooth edges."""
PERIOD_S: Final = 0.1
HOLD_S: Final = 3.0
"""The last frame stands so long."""
TRAIL_S: Final = 14.0
LETTERS: Final = 64
"""Of a reason in a line."""
ROBOT_M: Final = 0.28
JUMP_M: Final = 0.4
"""The trail has a gap where the pose moves further than this in one frame."""
INK: Final[Colour] = (28, 34, 48)
PAPER: Final[Colour] = (255, 255, 255)
QUIET: Final[Colour] = (110, 118, 130)
LAMP: Final[Colour] = (250, 204, 21)
UNUSED: Final[Colour] = (214, 214, 206)
UNKNOWN: Final[Colour] = (226, 229, 234)
GOOD, CAREFUL, SEARCHING = (0, 121, 145), (214, 128, 0), (170, 30, 110)
"""Blue-green, orange and purple: colour-blind readers distinguish them."""
HUES: Final[dict[State, Colour]] = {
    State.TRACKING: GOOD, State.MAPPING: CAREFUL, State.DEGRADED: CAREFUL, State.RELOCATING: SEARCHING,
    State.AMBIGUOUS: SEARCHING, State.LOST: SEARCHING,
}  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Ground:
    """What lies below: the map's pixels, rows from above, its lower left corner and its cell in m, and the lamps.

    ``lamps``: x, y by number, m in the map frame.
    """

    grey: npt.NDArray[np.uint8]
    corner: tuple[float, float]
    cell: float
    lamps: dict[int, tuple[float, float]]

    def part(self, low: tuple[float, float], high: tuple[float, float]) -> Ground:
        """Only what lies between two corners."""
        rows, columns = self.grey.shape
        left, right = (int(np.clip((x - self.corner[0]) / self.cell, 0, columns)) for x in (low[0], high[0]))
        below, above = (int(np.clip((y - self.corner[1]) / self.cell, 0, rows)) for y in (low[1], high[1]))
        corner = self.corner[0] + left * self.cell, self.corner[1] + below * self.cell
        return Ground(self.grey[rows - above : rows - below, left:right], corner, self.cell, self.lamps)


@dataclass(frozen=True, slots=True)
class Moment:
    """One instant: what was published, and the truth. ``lifted``: somebody carries the robot."""

    t: float
    state: State
    reason: int
    pose: Pose | None
    truth: Pose
    used: frozenset[int] = frozenset()
    lifted: bool = False

    @property
    def off_m(self) -> float:
        """Error of the published position, m; NaN without one."""
        return math.nan if self.pose is None else math.dist(self.pose[:2], self.truth[:2])


class Canvas:
    """One frame in metres of the map frame."""

    def __init__(self, ground: Ground) -> None:
        rows, columns = ground.grey.shape
        self.scale = SIDE * _FINE / (max(rows, columns) * ground.cell)
        wide, high = (round(cells * ground.cell * self.scale) for cells in (columns, rows))
        self.ground, self.foot = ground, HEAD * _FINE + high
        self.image = Image.new("RGB", (wide, self.foot + FOOT * _FINE), PAPER)
        ramps = zip(INK, UNKNOWN, PAPER, strict=True)
        tinted = np.stack([np.interp(ground.grey, (0, 205, 254), ramp) for ramp in ramps], axis=2)
        plan = Image.fromarray(tinted.astype(np.uint8)).resize((wide, high), Image.Resampling.NEAREST)
        self.image.paste(plan, (0, HEAD * _FINE))
        self.draw = ImageDraw.Draw(self.image)

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Pixel of a place."""
        return (x - self.ground.corner[0]) * self.scale, self.foot - (y - self.ground.corner[1]) * self.scale

    def disc(self, x: float, y: float, radius: float, fill: Colour | None, edge: Colour, width: int = 2) -> None:
        """A disc of ``radius`` m."""
        (u, v), r = self.at(x, y), radius * self.scale
        self.draw.ellipse((u - r, v - r, u + r, v + r), fill, edge, width * _FINE)

    def text(self, at: tuple[float, float], words: str, size: int, colour: Colour, bold: bool = False) -> None:
        """Text from its left upper corner, in pixels of the finished picture."""
        self.draw.text((at[0] * _FINE, at[1] * _FINE), words, colour, font(size * _FINE, bold))

    def finished(self) -> Image.Image:
        """The frame in its size."""
        wide, high = self.image.size
        return self.image.resize((wide // _FINE, high // _FINE), Image.Resampling.LANCZOS)


def font(size: int, bold: bool = False) -> ImageFont.FreeTypeFont:
    """DejaVu, which comes with matplotlib."""
    import matplotlib

    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name), size)


def frame(ground: Ground, past: Sequence[Moment]) -> Image.Image:
    """The picture of the last of ``past``, with the trail of the ones before."""
    now, canvas = past[-1], Canvas(ground)
    hue = HUES.get(now.state, INK)
    for number, (x, y) in ground.lamps.items():
        used = number in now.used
        if used and now.pose is not None and not now.lifted:
            canvas.draw.line((*canvas.at(x, y), *canvas.at(*now.pose[:2])), LAMP, 2 * _FINE)
        canvas.disc(x, y, 0.13, LAMP if used else UNUSED, INK if used else QUIET)
    _trail(canvas, [one for one in past if one.t > now.t - TRAIL_S])
    _true_robot(canvas, now)
    if now.pose is not None:
        _arrow(canvas, now.pose, hue)
    _words(canvas, now, hue)
    return canvas.finished()


def _trail(canvas: Canvas, past: Sequence[Moment]) -> None:
    for one, two in pairwise(past):
        if one.pose is not None and two.pose is not None and math.dist(one.pose[:2], two.pose[:2]) < JUMP_M:
            line = *canvas.at(*one.pose[:2]), *canvas.at(*two.pose[:2])
            canvas.draw.line(line, HUES.get(two.state, INK), 2 * _FINE)


def _true_robot(canvas: Canvas, now: Moment) -> None:
    x, y, yaw = now.truth
    canvas.disc(x, y, ROBOT_M, None, QUIET if now.lifted else INK)
    nose = canvas.at(x + ROBOT_M * math.cos(yaw), y + ROBOT_M * math.sin(yaw))
    canvas.draw.line((*canvas.at(x, y), *nose), QUIET if now.lifted else INK, 2 * _FINE)


def _arrow(canvas: Canvas, pose: Pose, hue: Colour) -> None:
    x, y, yaw = pose
    corners = [(0.34, 0.0), (-0.22, 0.2), (-0.12, 0.0), (-0.22, -0.2)]
    c, s = math.cos(yaw), math.sin(yaw)
    canvas.draw.polygon([canvas.at(x + c * a - s * b, y + s * a + c * b) for a, b in corners], hue, PAPER)


def _words(canvas: Canvas, now: Moment, hue: Colour) -> None:
    canvas.text((10, 8), now.state.name, 22, hue, bold=True)
    canvas.text((200, 14), f"{now.t:4.1f} s", 14, QUIET)
    if not now.lifted and math.isfinite(now.off_m):
        off = f"pose is {100 * now.off_m:.0f} cm off" if now.off_m < 1.0 else f"pose is {now.off_m:.1f} m off"
        canvas.text((400, 14), off, 14, INK)
    words = "The robot is lifted and carried away." if now.lifted else REASONS[Reason(now.reason)][0].capitalize() + "."
    for number, line in enumerate(textwrap.wrap(words, LETTERS)[:2]):
        canvas.text((10, 42 + 20 * number), line, 15, INK)
    left, top = 10.0, canvas.foot / _FINE + 9
    entries = ((hue, "published pose"), (None, "true robot"), (LAMP, "lamp in use"), (UNUSED, "other lamp"))
    for fill, label in entries:
        box = (left * _FINE, (top + 2) * _FINE, (left + 12) * _FINE, (top + 14) * _FINE)
        canvas.draw.ellipse(box, fill, INK, _FINE)
        canvas.text((left + 18, top), label, 13, INK)
        left += 34 + 7.4 * len(label)
    bar = canvas.scale / _FINE
    right = canvas.image.width / _FINE - 10
    canvas.draw.line(((right - bar) * _FINE, (top + 13) * _FINE, right * _FINE, (top + 13) * _FINE), INK, 3 * _FINE)
    canvas.text((right - 0.5 * bar - 12, top - 7), "1 m", 13, INK)


def _palette() -> Image.Image:
    """All colours, and mixtures of each with paper and of the dark ones with others, for smooth edges."""
    pure = [INK, QUIET, LAMP, UNUSED, UNKNOWN, *dict.fromkeys(HUES.values())]
    pairs = [(one, PAPER) for one in pure] + [(one, LAMP) for one in pure] + [(INK, UNKNOWN), (QUIET, UNUSED)]
    shades = [PAPER, *pure, *(_mixed(one, two, share) for one, two in pairs for share in (0.25, 0.5, 0.75))]
    made = Image.new("P", (1, 1))
    made.putpalette([part for shade in shades for part in shade])
    return made


def _mixed(one: Colour, two: Colour, share: float) -> Colour:
    red, green, blue = (round(share * a + (1.0 - share) * b) for a, b in zip(one, two, strict=True))
    return red, green, blue


def write(path: Path, ground: Ground, moments: Sequence[Moment]) -> int:
    """Writes the GIF, a frame a moment, which repeats for ever; returns its bytes."""
    drawn = [frame(ground, moments[: k + 1]) for k in range(len(moments))]
    palette = _palette()
    few = [one.quantize(palette=palette, dither=Image.Dither.NONE) for one in drawn]
    times = [round(1e3 * PERIOD_S)] * (len(few) - 1) + [round(1e3 * HOLD_S)]
    few[0].save(path, save_all=True, append_images=few[1:], duration=times, loop=0, optimize=False)
    return path.stat().st_size
