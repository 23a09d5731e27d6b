"""A decoded image: pixel values as in the file, and their brightness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Shades = npt.NDArray[np.float64]
Values = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]


class BadPicture(Exception):
    """An image that cannot be used; the text states the reason and the remedy."""


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """Pixel values (rows, columns, channels), top row first: 1 or 3 colours, then the opacity where there is one.

    Attributes:
        largest: value of white, and of full opacity. transparent: whether the last channel is the opacity.
    """

    values: Values
    largest: int
    transparent: bool = False

    @property
    def grey(self) -> Shades:
        """Mean of the colours, 0 black to 1 white."""
        colours = self.values[..., : self.values.shape[2] - self.transparent]
        return np.asarray(colours.mean(axis=2) / self.largest)

    @property
    def alpha(self) -> Shades | None:
        """Opacity, 1 opaque; None where the image has none."""
        return self.values[..., -1] / float(self.largest) if self.transparent else None

    def rows(self, part: slice) -> Picture:
        """Some of the rows."""
        return Picture(self.values[part], self.largest, self.transparent)


def check_size(columns: int, rows: int, most: int, remedy: str = "") -> None:
    """Raise `BadPicture` for an image of more than ``most`` pixels, or none."""
    if columns < 1 or rows < 1 or columns * rows > most:
        raise BadPicture(f"has {columns} x {rows} pixels; the limit is {most}{remedy}")
