"""The sensor's parser of SCIP commands: a request, or the status of its refusal (C-42-03320B)."""

from __future__ import annotations

import re
from dataclasses import dataclass

from hal.fake.lidar.models import LidarModel

STREAMS = frozenset({"MD", "MS", "ME", "ND", "NE"})
SINGLES = frozenset({"GD", "GS", "GE", "HD", "HE"})

PARAMETERS = {
    "VV": 0, "PP": 0, "II": 0, "BM": 0, "QT": 0, "RS": 0, "RT": 0, "RB": 0,
    "TM": 1, "SS": 6, "CR": 2, "HS": 1, "%ST": 0, "%SL": 0,
}  # fmt: skip
"""Parameter characters of each command other than measurements; the ``%`` commands are SCIP 2.2."""

STREAM_PARAMETERS = 13
SINGLE_PARAMETERS = 10
MAX_TAG = 16
TAG = re.compile(rb"[A-Za-z0-9 ._+@]*\Z")
LINE_ENDS = re.compile(rb"[\r\n]")


@dataclass(frozen=True, slots=True)
class Request:
    """A valid command. ``echo`` is the received line with its tag; ``tag`` begins with ``;``."""

    echo: bytes
    name: str
    parameters: bytes
    tag: bytes


@dataclass(frozen=True, slots=True)
class Refusal:
    """An invalid line, answered with ``status`` in every state."""

    echo: bytes
    status: str


@dataclass(frozen=True, slots=True)
class Measure:
    """Parameters of a measurement command. ``cluster`` is at least 1; ``count`` 0 is endless."""

    start: int
    end: int
    cluster: int
    skip: int
    count: int


def letters(line: bytes) -> str:
    """The command's name: two characters, or three beginning with ``%``."""
    return line[: 3 if line.startswith(b"%") else 2].decode("ascii", errors="replace")


def parameter_count(name: str, model: LidarModel) -> int | None:
    """Number of parameter characters of a command; None where the model does not have it."""
    if name in model.measures:
        return STREAM_PARAMETERS if name in STREAMS else SINGLE_PARAMETERS
    if name.startswith("%") and model.profile != "2.2":
        return None
    return PARAMETERS.get(name)


def parse(line: bytes, model: LidarModel) -> Request | Refusal:
    """Parse a line without its end."""
    body, mark, tag = line.partition(b";")
    name = letters(body)
    wanted = parameter_count(name, model)
    if wanted is None:
        return Refusal(line, "0E")
    parameters = body[len(name) :]
    if len(parameters) < wanted:
        return Refusal(line, "0C")
    if len(parameters) > wanted:
        return Refusal(line, "0D")
    if len(tag) > MAX_TAG:
        return Refusal(line, "0G")
    if not TAG.match(tag):
        return Refusal(line, "0H")
    return Request(line, name, parameters, mark + tag)


def measure(request: Request, model: LidarModel) -> Measure | str:
    """Parse the parameters of a measurement; a ``str`` is the status of their refusal."""
    text = request.parameters
    fields = {"01": text[0:4], "02": text[4:8], "03": text[8:10]}
    if request.name in STREAMS:
        fields |= {"06": text[10:11], "07": text[11:13]}
    for status, digits in fields.items():
        if not digits.isdigit():
            return status
    start, end, cluster = int(fields["01"]), int(fields["02"]), int(fields["03"])
    if start < model.amin or end > model.amax:
        return "04"
    if end < start:
        return "05"
    return Measure(start, end, max(1, cluster), int(fields.get("06", b"0")), int(fields.get("07", b"0")))
