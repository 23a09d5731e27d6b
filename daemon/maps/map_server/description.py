"""YAML description of a map of ROS map_server and nav2.

Semantics: nav2_map_server's and map_server's documentation (wiki.ros.org/map_server, "YAML format"). Keys that these
do not know are ignored.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.maps.map_server.yaml_document import BadYaml, Node, parse

OCCUPIED: Final = 0.65
FREE: Final = 0.196
"""map_server's trinary thresholds; 205 reads as 0.19608, just above FREE, so that unknown stays unknown."""
MODES: Final = ("trinary", "scale", "raw")
_TRUE: Final = ("1", "true", "yes", "on", "y")
_FALSE: Final = ("0", "false", "no", "off", "n")
_NUMBER: Final = re.compile(r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?")


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


def describe(path: Path, text: str) -> Description:
    """Parse the YAML text.

    Raises:
        BadMapServer: a field is missing or invalid.
    """
    fields = _fields(path, text)
    for key in ("image", "resolution", "origin"):
        if key not in fields:
            raise BadMapServer(f"{path}: `{key}` is missing; map_server's files have one")
    image = fields["image"]
    if not isinstance(image, str) or not image or "\0" in image:
        raise BadMapServer(f"{path}: `image` must be the name of an image file")
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
    if not isinstance(mode, str) or mode not in MODES:
        raise BadMapServer(f"{path}: `mode` is {mode}; it must be one of {', '.join(MODES)}")
    negate = fields.get("negate", "0")
    word = _word(negate)
    if word not in (*_TRUE, *_FALSE):
        raise BadMapServer(f"{path}: `negate` is {negate}; it must be 0 or 1")
    origin = _origin(path, fields["origin"])
    return Description(path.parent / image, resolution, origin, word in _TRUE, occupied, free, mode)


def _word(node: Node) -> str:
    """A truth value in lower case; YAML has it so, with a capital, or in capitals."""
    text = node if isinstance(node, str) else ""
    return text.lower() if text in (text.lower(), text.upper(), text.capitalize()) else ""


def _origin(path: Path, value: Node) -> tuple[float, float, float]:
    numbers = [_number(path, "origin", one) for one in value] if isinstance(value, list) else []
    if len(numbers) not in (2, 3):
        raise BadMapServer(f"{path}: `origin` must be [x, y, yaw] of the lower left corner, m and rad")
    x, y, yaw = (*numbers, 0.0)[:3]
    return x, y, yaw


def _number(path: Path, key: str, text: Node) -> float:
    number = float(text) if isinstance(text, str) and _NUMBER.fullmatch(text) else math.nan
    if not math.isfinite(number):
        raise BadMapServer(f"{path}: `{key}` is {text}; it must be a number")
    return number


def _fields(path: Path, text: str) -> dict[str, Node]:
    """Keys and values of the document."""
    try:
        document = parse(text)
    except BadYaml as error:
        raise BadMapServer(f"{path}: {error}") from None
    if not isinstance(document, dict):
        raise BadMapServer(f"{path}: line 1 is not `key: value`; name map_server's YAML file")
    return document
