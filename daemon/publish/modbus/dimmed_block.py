"""Modbus block for PWM-dimmed lamps in view: frequency, a frequency that looks alike, and swing of each.

    Modbus    magic u16, version u16 | seq u32, POINTS, big-endian, high word first | seq_end u32     at 440

The contract is that of the other tables: under the same version a point never moves and never changes its meaning.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Final

from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import U32, Point, Value
from daemon.snapshot import LISTED_DIMMED, Snapshot


def _of_lamp(row: int, name: str) -> Callable[[Snapshot], Value]:
    value = attrgetter(name)

    def get(snapshot: Snapshot) -> Value:
        lamps = () if snapshot.light is None else snapshot.light.dimmed
        return value(lamps[row]) if row < len(lamps) else None

    return get


def _row(row: int) -> tuple[Point, ...]:
    name, label = f"dimmed_{row + 1}", f"PWM lamp {row + 1}"
    return (
        Point(f"{name}_frequency", f"{label}, frequency", U32, _of_lamp(row, "hertz"), "Not known: no further "
              "PWM-dimmed lamp.", 10, "Hz"),
        Point(f"{name}_other", f"{label}, other frequency", U32, _of_lamp(row, "other_hertz"), "Fits "
              "the samples as well. Not known: none does.", 10, "Hz"),
        Point(f"{name}_swing", f"{label}, swing", U32, _of_lamp(row, "swing"), "Photocurrent between off "
              "and on.", 10**12, "A"),
    )  # fmt: skip


BLOCK: Final = Block("dimmed lamps", 440, "LD", 1, tuple(point for row in range(LISTED_DIMMED) for point in _row(row)))
