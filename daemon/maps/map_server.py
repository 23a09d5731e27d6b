"""Import of ROS map_server and nav2 maps: a YAML description and an image, converted to trinary cells.

Semantics: nav2_map_server's and map_server's documentation (wiki.ros.org/map_server, "YAML format" and "Value
interpretation"). The parser accepts the subset of YAML in such files: ``key: value`` lines, lists in one line or with
dashes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps.grey_image import BadPicture, Picture, read_picture

Trinary = npt.NDArray[np.int8]
"""(rows, columns), row 0 at the bottom: 1 occupied, 0 free, -1 unknown."""

OCCUPIED: Final = 0.65
FREE: Final = 0.196
"""map_server's trinary thresholds; 205 reads as 0.19608, just above FREE, so that unknown stays unknown."""
MODES: Final = ("trinary", "scale", "raw")
KNOWN: Final = ("image", "resolution", "origin", "negate", "occupied_thresh", "free_thresh", "mode")
MOST_CELLS: Final = 50_000_000


class BadMapServer(Exception):
    """A description or an image that cannot be used; the text names the file, the defect, and the remedy."""


@dataclass(frozen=True, slots=True)
class Description:
    """Content of the YAML file.

    Attributes:
        image: path of the image. resolution: m per pixel. origin: (x, y, yaw) of the lower left corner. negate: white
            is occupied. occupied, free: thresholds of the probability. mode: one of :data:`MODES`.
    """

    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool = False
    occupied: float = OCCUPIED
    free: float = FREE
    mode: str = "trinary"


def load(path: Path) -> tuple[Description, Trinary]:
    """Read the description and the cells of a map.

    Raises:
        BadMapServer: either cannot be used.
    """
    try:
        text = path.read_bytes().decode()
    except OSError as error:
        raise BadMapServer(f"{path}: cannot be read: {error.strerror}; name map_server's YAML file") from error
    except UnicodeDecodeError as error:
        raise BadMapServer(f"{path}: is not text; name map_server's YAML file, not the picture") from error
    described = describe(path, text)
    try:
        picture = read_picture(described.image.read_bytes(), MOST_CELLS)
    except OSError as error:
        wrong = f"the picture {described.image} cannot be read: {error.strerror}"
        raise BadMapServer(f"{path}: {wrong}; put it there, or correct `image`") from error
    except BadPicture as error:
        raise BadMapServer(f"{described.image}: {error}") from error
    return described, cells_of(described, picture)


def describe(path: Path, text: str) -> Description:
    """Parse the YAML text.

    Raises:
        BadMapServer: a field is missing or invalid.
    """
    fields = _fields(path, text)
    for key in ("image", "resolution", "origin"):
        if key not in fields:
            raise BadMapServer(f"{path}: has no `{key}`; map_server's files have one")
    image = fields["image"]
    if not isinstance(image, str) or not image or "\0" in image:
        raise BadMapServer(f"{path}: `image` must be the name of a picture")
    resolution = _number(path, "resolution", fields["resolution"])
    if not 0.001 <= resolution <= 1.0:
        raise BadMapServer(f"{path}: `resolution` is {resolution:g} m per pixel; it must be 0.001 to 1")
    occupied = _number(path, "occupied_thresh", fields.get("occupied_thresh", "0.65"))
    free = _number(path, "free_thresh", fields.get("free_thresh", "0.196"))
    if not 0.0 <= free < occupied <= 1.0:
        raise BadMapServer(
            f"{path}: `free_thresh` {free:g} and `occupied_thresh` {occupied:g} must be 0 to 1, and free the smaller"
        )
    mode = fields.get("mode", "trinary")
    if mode not in MODES:
        raise BadMapServer(f"{path}: `mode` is {mode}; it must be one of {', '.join(MODES)}")
    negate = fields.get("negate", "0")
    if negate not in ("0", "1", "false", "true"):
        raise BadMapServer(f"{path}: `negate` is {negate}; it must be 0 or 1")
    return Description(
        path.parent / image, resolution, _origin(path, fields["origin"]), negate in ("1", "true"), occupied, free, mode
    )


def _origin(path: Path, value: str | list[str]) -> tuple[float, float, float]:
    numbers = [_number(path, "origin", one) for one in value] if isinstance(value, list) else []
    if len(numbers) not in (2, 3):
        raise BadMapServer(f"{path}: `origin` must be [x, y, yaw] of the lower left corner, m and rad")
    x, y, yaw = (*numbers, 0.0)[:3]
    return x, y, yaw


def _number(path: Path, key: str, text: str | list[str]) -> float:
    try:
        number = float(text)  # type: ignore[arg-type]  # a list is what the except is for
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise BadMapServer(f"{path}: `{key}` is {text}; it must be a number")
    return number


def _fields(path: Path, text: str) -> dict[str, str | list[str]]:
    """Keys and values as text; a list as a list of text. Unknown keys are ignored, as by map_server."""
    fields: dict[str, str | list[str]] = {}
    key = ""
    for number, raw in enumerate(text.lstrip("\ufeff").splitlines(), 1):
        line = _uncommented(raw).strip()
        if not line or line in ("---", "...") or line.startswith("%"):
            continue
        if line.startswith("- ") and key:
            listed = fields.get(key)
            fields[key] = [*(listed if isinstance(listed, list) else []), line[2:].strip()]
            continue
        name, colon, value = line.partition(":")
        if not colon or (raw[:1].isspace() and key):
            raise BadMapServer(f"{path}: line {number} is not `key: value`: {line[:60]}")
        key = name.strip().strip("'\"")
        value = value.strip()
        if key in fields:
            raise BadMapServer(f"{path}: line {number} says `{key}` a second time")
        if value.startswith("["):
            if not value.endswith("]"):
                raise BadMapServer(f"{path}: line {number}: the list of `{key}` has no end; write it in one line")
            fields[key] = [part.strip() for part in value[1:-1].split(",")]
        else:
            fields[key] = value[1:-1] if value[:1] in "'\"" and value[-1:] == value[:1] and len(value) > 1 else value
    return fields


def _uncommented(line: str) -> str:
    """The line without its comment: a ``#`` outside quotes, at the line's start or after a blank, and what follows."""
    quote = ""
    for at, character in enumerate(line):
        if quote:
            quote = "" if character == quote else quote
        elif character in "'\"":
            quote = character
        elif character == "#" and (at == 0 or line[at - 1].isspace()):
            return line[:at]
    return line


def cells_of(described: Description, picture: Picture) -> Trinary:
    """Cells by map_server's rules for the mode."""
    grey, alpha = picture.grey[::-1], None if picture.alpha is None else picture.alpha[::-1]
    if described.mode == "raw":
        value = np.rint(255.0 * grey)
        known = value <= 100.0
        probability = value / 100.0
    else:
        shade = grey
        if described.mode == "trinary" and alpha is not None:  # map_server averages transparency as one more colour
            shade = (grey * picture.colours + alpha) / (picture.colours + 1)
        probability = shade if described.negate else 1.0 - shade
        known = np.ones(grey.shape, np.bool_)
        if described.mode == "scale" and alpha is not None:
            known = alpha >= 1.0
    cells = np.full(grey.shape, -1, np.int8)
    cells[known & (probability > described.occupied)] = 1
    cells[known & (probability < described.free)] = 0
    return cells
