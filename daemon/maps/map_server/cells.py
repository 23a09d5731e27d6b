"""A map of map_server: its YAML file and its image, read within bounds and converted to trinary cells."""

from __future__ import annotations

import errno
import os
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps.map_server.description import BadMapServer, Description, describe
from daemon.maps.map_server.picture import read_picture
from daemon.maps.map_server.pixels import BadPicture, Picture
from daemon.system.regular_file import read_regular

Trinary = npt.NDArray[np.int8]
"""(rows, columns), row 0 at the bottom: 1 occupied, 0 free, -1 unknown."""

MOST_CELLS: Final = 50_000_000
MOST_TEXT: Final = 1 << 16
"""Bytes of a YAML file."""
MOST_IMAGE: Final = 6 * MOST_CELLS
"""Bytes of an image file: five digits and a blank for each pixel."""
_BAND: Final = 256
"""Rows that are converted at once, so that the memory for brightness stays small."""
_COLOURS: Final = 3
"""map_server and nav2 see a grey pixel as three equal colours."""


def load(path: Path) -> tuple[Description, Trinary]:
    """Read the description and the cells of a map.

    Raises:
        BadMapServer: either cannot be used.
    """
    try:
        text = read_regular(path, MOST_TEXT).decode()
    except OSError as error:
        raise BadMapServer(f"{path}: cannot be read: {error.strerror}; name map_server's YAML file") from error
    except UnicodeDecodeError as error:
        raise BadMapServer(f"{path}: not a text file; name map_server's YAML file, not the image") from error
    described = describe(path, text)
    try:
        picture = read_picture(read_regular(_within(path, described.image), MOST_IMAGE), MOST_CELLS)
    except OSError as error:
        wrong = f"the image {described.image} cannot be read: {error.strerror}"
        raise BadMapServer(f"{path}: {wrong}; copy it there, or correct `image`") from error
    except BadPicture as error:
        raise BadMapServer(f"{described.image}: {error}") from error
    return described, cells_of(described, picture)


def _within(path: Path, image: Path) -> Path:
    """The image's path without links.

    Raises:
        OSError: there is no such file, or a link leads out of the folder of the YAML file (of the image if that is
            named elsewhere).
    """
    folder = path.parent.resolve()
    relative = Path(os.path.relpath(image, path.parent))
    inside = relative.parts[0] != os.pardir
    named = folder / relative if inside else Path(os.path.normpath(Path.cwd() / image))
    base = folder if inside else named.parent.resolve()
    try:
        found = named.resolve(strict=True)
    except RuntimeError:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(named)) from None
    if not found.is_relative_to(base):
        raise OSError(errno.EXDEV, f"it is a link out of its folder, to {found}", str(named))
    return found


def cells_of(described: Description, picture: Picture) -> Trinary:
    """Cells by map_server's rules for the mode."""
    count = len(picture.values)
    bands = [_band(described, picture.rows(slice(at, at + _BAND))) for at in range(0, count, _BAND)]
    return np.concatenate(bands)[::-1]


def _band(described: Description, picture: Picture) -> Trinary:
    grey, alpha = picture.grey, picture.alpha
    known = np.ones(grey.shape, np.bool_)
    if described.mode == "raw":
        value = np.rint(255.0 * grey)
        known = value <= 100.0
        probability = value / 100.0
    else:
        shade = grey
        if described.mode == "trinary" and alpha is not None:  # the opacity counts as one more colour
            shade = (_COLOURS * grey + alpha) / (_COLOURS + 1)
        probability = shade if described.negate else 1.0 - shade
        if described.mode == "scale" and alpha is not None:
            known = alpha >= 1.0
    cells = np.full(grey.shape, -1, np.int8)
    cells[known & (probability > described.occupied)] = 1
    cells[known & (probability < described.free)] = 0
    return cells
