"""Markdown tables for the generated protocol documents, made from the published tables."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Final

from daemon.publish.modbus import registers
from daemon.publish.modbus.holding import COMMAND, COMMAND_ADDRESS, CommandCode
from daemon.publish.modbus.points import Layout, Point, Rule

NOTICE: Final = (
    "<!-- Written by `python -m daemon.publish.document`; edit the tables in daemon/publish, not this file. -->"
)
NOT_KNOWN: Final = """A value that is *not known* reads as all ones (unsigned) or as the smallest number (signed), as in
SunSpec. The column shows where this can happen. Measurements saturate and never wrap. Counters wrap: take differences
modulo their width."""


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _step(point: Point) -> str:
    unit = f" {point.unit}" if point.unit else ""
    return f"1/{point.per_unit}{unit}" if point.per_unit > 1 else point.unit


def _not_known(point: Point) -> str:
    width = point.wire.bits // 4
    return f"0x{point.wire.not_known % (1 << point.wire.bits):0{width}X}" if point.can_be_unknown else ""


def _describe(point: Point) -> str:
    wraps = " Wraps." if point.rule is Rule.WRAP else ""
    return f"{point.label[0].upper()}{point.label[1:]}. {point.text}{wraps}".strip()


def layout_rows(layout: Layout, start: int, step: int, notes: bool = True) -> list[tuple[str, ...]]:
    """Rows of a layout; `start` and `step` convert a word offset to a register address or a byte.

    Without `notes` a row has the name of the value only.
    """
    return [
        (
            str(start + step * offset),
            f"`{p.name}`",
            p.wire.name,
            _step(p),
            _not_known(p),
            _describe(p) if notes else f"{p.label[0].upper()}{p.label[1:]}.",
        )
        for offset, p in zip(layout.offsets, layout.points, strict=True)
    ]


def holding_rows(layout: Layout, start: int) -> list[tuple[str, ...]]:
    """The same rows with the permitted access."""
    return [
        (str(start + offset), f"`{p.name}`", p.wire.name, p.access, _step(p), _not_known(p), _describe(p))
        for offset, p in zip(layout.offsets, layout.points, strict=True)
    ]


def bit_rows(bits: tuple[registers.Bit, ...]) -> list[tuple[str, ...]]:
    """Rows of named bits."""
    return [(str(number), f"`{name}`", text) for number, (name, text, _) in enumerate(bits)]


MBPOLL: Final = "mbpoll -m tcp -p 1502 -t 4{kind} -0 -r {address}"
"""Write or read of holding registers, with addresses from 0."""


def order_lines() -> str:
    """A line of ``mbpoll`` for every command, as a block of Markdown."""
    at = dict(zip((point.name for point in COMMAND.points), COMMAND.offsets, strict=True))
    pose, map_id, answer = (COMMAND_ADDRESS + at[name] for name in ("x", "map_id", "acknowledge"))
    before = {
        CommandCode.SET_POSE: MBPOLL.format(kind=":int -B", address=pose)
        + " HOST -- 15000 -20000 1570796     # x 1.5 m, y -2 m, yaw 1.570796 rad",
        CommandCode.SWITCH_MAP: MBPOLL.format(kind=":hex", address=map_id) + " HOST 0x1a2b 0x3c4d     # map 1a2b3c4d",
    }
    lines = []
    for number, code in enumerate(CommandCode, 1):
        lines += [before[code]] if code in before else []
        order = MBPOLL.format(kind="", address=COMMAND_ADDRESS)
        lines.append(f"{order} HOST {number} {code.value}     # {code.name}")
    result = MBPOLL.format(kind="", address=answer)
    lines.append(f"{result} -c 2 -1 HOST     # request's number, result")
    return "\n".join(f"    {line}" for line in lines)
