"""The page's own files: the contrasts of its colours by WCAG 2.2, and its size."""

import re
from importlib import resources
from typing import Final

import pytest

from taps.view.server import pages

FOLDER: Final = resources.files("taps.view").joinpath("page")
TEXT: Final = ("ink", "dim", "faint", "accent", "good", "teal", "warn", "seek", "bad")
DRAWN: Final = (*TEXT, "scan", "wall")
"""On the map."""
CHIP: Final = 0.10
"""Share of the state's colour in the background of its chip."""
LEAST_TEXT, LEAST_DRAWN, LEAST_FREE = 4.5, 3.0, 1.6
LARGEST_PAGE = 300_000

Colour = tuple[float, ...]


def themes() -> dict[str, dict[str, Colour]]:
    """The opaque colours of each theme by name."""
    found = {}
    blocks = re.findall(r"^:root[^{]*\{([^}]*)\}", FOLDER.joinpath("style.css").read_text(), re.MULTILINE)
    for name, body in zip(("dark", "light"), blocks, strict=True):
        pairs = re.findall(r"--([a-z-]+): #([0-9a-f]{6});", body)
        found[name] = {key: tuple(int(value[k : k + 2], 16) / 255.0 for k in (0, 2, 4)) for key, value in pairs}
    return found


def luminance(colour: Colour) -> float:
    red, green, blue = (c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour)
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def contrast(one: Colour, other: Colour) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def mixed(one: Colour, other: Colour, share: float) -> Colour:
    return tuple(share * a + (1.0 - share) * b for a, b in zip(one, other, strict=True))


def test_contrast_is_that_of_the_standard() -> None:
    """Black on white is 21, and the darkest grey that passes on white is #767676."""
    white, grey = (1.0, 1.0, 1.0), (0x76 / 255.0,) * 3
    assert contrast(white, (0.0, 0.0, 0.0)) == pytest.approx(21.0)
    assert contrast(grey, white) == pytest.approx(4.54, abs=0.005)


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_what_is_read_and_drawn_stands_out(theme: str) -> None:
    c = themes()[theme]
    low = [
        *((a, b) for a in TEXT for b in ("card", "panel") if contrast(c[a], c[b]) < LEAST_TEXT),
        *((a, "chip") for a in TEXT if contrast(c[a], mixed(c[a], c["panel"], CHIP)) < LEAST_TEXT),
        *((a, b) for a in DRAWN for b in ("free", "bg") if contrast(c[a], c[b]) < LEAST_DRAWN),
    ]
    assert low == []
    assert contrast(c["go-ink"], c["accent"]) >= LEAST_TEXT
    assert contrast(c["free"], c["bg"]) >= LEAST_FREE
    faintest = re.search(r"FAINTEST = ([0-9.]+);", FOLDER.joinpath("tiles.js").read_text())
    assert faintest is not None
    assert contrast(mixed(c["free"], c["bg"], float(faintest[1])), c["bg"]) >= LEAST_FREE
    for ground in ("free", "bg"):  # a lamp is seen by its disc or by the edge of it
        assert max(contrast(c[name], c[ground]) for name in ("lamp", "lamp-edge")) >= LEAST_DRAWN


def test_all_colours_are_those_of_the_themes() -> None:
    style = FOLDER.joinpath("style.css").read_text()
    assert not re.findall(r"(?<![-\w])color:(?! *(?:var|inherit|color-mix))[^;]+;", style)
    share = re.search(r"\.chip \{[^}]*background: color-mix\(in srgb, var\(--c\) (\d+)%", style)
    assert share is not None
    assert float(share[1]) == 100.0 * CHIP
    used = set(re.findall(r"var\(--([a-z-]+)\)", style)) - {"c", "head", "shadow"}
    for name, colours in themes().items():
        assert used <= {*colours, "grid"}, name


def test_the_page_is_small() -> None:
    assert sum(len(body) for body in pages()[1].values()) <= LARGEST_PAGE
