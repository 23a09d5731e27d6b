"""Text as pixels: a font of 5 x 7 dots, for labels of pictures."""

from __future__ import annotations

from typing import Final

import numpy as np
import numpy.typing as npt

Bitmap = npt.NDArray[np.bool_]

SCALE: Final = 2
"""Pixels of a dot's side."""
_HEIGHT: Final = 8
"""Dots, one row below the line included."""
_DOTS: Final = {
    "0": "3e5149453e", "1": "00427f4000", "2": "4261514946", "3": "2141454b31", "4": "1814127f10",
    "5": "2745454539", "6": "3c4a494930", "7": "0171090503", "8": "3649494936", "9": "064949291e",
    "a": "2054545478", "b": "7f48444438", "c": "3844444420", "d": "384444487f", "e": "3854545418",
    "f": "087e090102", "g": "18a4a4a47c", "h": "7f08040478", "i": "00447d4000", "j": "4080847d00",
    "k": "7f10284400", "l": "00417f4000", "m": "7c04180478", "n": "7c08040478", "o": "3844444438",
    "p": "fc24242418", "q": "18242418fc", "r": "7c08040408", "s": "4854545420", "t": "043f444020",
    "u": "3c4040207c", "v": "1c2040201c", "w": "3c4030403c", "x": "4428102844", "y": "1ca0a0a07c",
    "z": "4464544c44", "-": "0808080808", ".": "0060600000", ",": "0050300000", "(": "001c224100",
    ")": "0041221c00", ":": "0036360000", " ": "000000",
}  # fmt: skip
"""Columns of each character from the left, two hexadecimal digits each; the lowest bit is the top row."""


def word(text: str, scale: int = SCALE) -> Bitmap:
    """(8 * scale, columns) bitmap of a text, true where there is ink; lower-case letters, digits, ``-.,():``."""
    columns = np.concatenate([np.frombuffer(bytes.fromhex(_DOTS[letter] + "00"), np.uint8) for letter in text])
    dots = (columns >> np.arange(_HEIGHT)[:, None]) & 1 == 1
    return np.asarray(dots.repeat(scale, axis=0).repeat(scale, axis=1))


def write(pixels: npt.NDArray[np.uint8], ink: Bitmap, top: int, left: int, colour: npt.NDArray[np.float64]) -> None:
    """Put ``ink`` into an image (rows, columns, 3) where it fits; what lies beyond the edge is left out."""
    rows, columns = pixels.shape[:2]
    row, column = np.nonzero(ink)
    row, column = row + top, column + left
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    pixels[row[inside], column[inside]] = colour
