"""Modbus block and pose datagram tail for light: the light solution and the links in view.

    Modbus    magic u16, version u16 | seq u32, HEAD, 16 ROWs, big-endian, high word first | seq_end u32     at 200
    datagram  TAIL, little-endian, behind the body of :mod:`daemon.publish.modbus.registers`

The contract is that of the other tables: under the same version a point never moves and never changes its meaning.
The block is encoded only when a client reads it; most clients never do.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Final

from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import I16, I32, U16, U32, Layout, Point, Rule, Value
from daemon.snapshot import LISTED_LINKS, LightFix, Snapshot

Getter = Callable[[Snapshot], Value]

_FIXES: Final = ", ".join(f"{fix.value} {fix.name}" for fix in LightFix)


def _light(name: str) -> Getter:
    """Getter of a value of the light solution; None where there is no photodiode."""
    value = attrgetter(name)
    return lambda snapshot: None if snapshot.light is None else value(snapshot.light)


def _count(name: str) -> Getter:
    """Getter of a counter of the light solution; 0 where there is no photodiode."""
    value = attrgetter(name)
    return lambda snapshot: 0 if snapshot.light is None else value(snapshot.light)


def _part(name: str, index: int) -> Getter:
    """Getter of one component of a triple that may be missing as a whole."""
    triple = attrgetter(name)

    def get(snapshot: Snapshot) -> Value:
        values = None if snapshot.light is None else triple(snapshot.light)
        return None if values is None else float(values[index])

    return get


def _yaw(snapshot: Snapshot) -> Value:
    yaw = _part("pose", 2)(snapshot)
    return None if yaw is None or not math.isfinite(yaw) else math.remainder(yaw, math.tau)


def _age(snapshot: Snapshot) -> Value:
    t_mono = None if snapshot.light is None else snapshot.light.t_mono
    return None if t_mono is None else snapshot.t_sent - t_mono


def _of_link(row: int, name: str) -> Getter:
    value = attrgetter(name)

    def get(snapshot: Snapshot) -> Value:
        links = () if snapshot.light is None else snapshot.light.links
        return value(links[row]) if row < len(links) else None

    return get


_SIGMA: Final = "One standard deviation, rounded up; the largest value means this or more."


def _estimate() -> tuple[Point, ...]:
    """Points of the light solution's position, in the same order in the block and in the datagram."""
    return (
        Point("light_fix", "state of the light filter", U16, _light("fix"), f"{_FIXES}. Not known: no photodiode."),
        Point("light_used", "links used", U16, _light("used"), "Lamps in the light solution."),
        Point("light_x", "position x, light solution", I32, _part("pose", 0), "Map frame, without the lidar.",
              10_000, "m"),
        Point("light_y", "position y, light solution", I32, _part("pose", 1), "Map frame.", 10_000, "m"),
        Point("light_yaw", "heading, light solution", I32, _yaw, "Map frame, in [-pi, pi].", 1_000_000, "rad"),
        Point("light_sigma_x", "sigma of light_x", U16, _part("sigma", 0), _SIGMA, 10_000, "m", ceil=True),
        Point("light_sigma_y", "sigma of light_y", U16, _part("sigma", 1), _SIGMA, 10_000, "m", ceil=True),
        Point("light_sigma_yaw", "sigma of light_yaw", U16, _part("sigma", 2), _SIGMA, 10_000, "rad", ceil=True),
        Point("light_age", "age of the light", U16, _age,
          "From the end of the latest usable block of samples to the time of sending.", 10_000, "s"),
    )  # fmt: skip


def _row(row: int) -> tuple[Point, ...]:
    name, label = f"link_{row + 1}", f"link {row + 1}"
    return (
        Point(f"{name}_code", f"{label}, code", U16, _of_link(row, "code"), "Number of the CDMA code as received. Not "
              "known: no further link."),
        Point(f"{name}_lamp", f"{label}, lamp", U16, _of_link(row, "lamp_id"),
          "Number of the lamp. Not known: no lamp has this code, or several have it."),
        Point(f"{name}_use", f"{label}, use", U16, _of_link(row, "use"), "See below."),
        Point(f"{name}_strength", f"{label}, strength", U32, _of_link(row, "strength"), "Amplitude of the modulated "
              "photocurrent.", 10**12, "A"),
        Point(f"{name}_residual", f"{label}, residual", I16, _of_link(row, "residual"),
          "Natural logarithm of received over expected RSS.", 10_000),
    )  # fmt: skip


BLOCK: Final = Block(
    "lights", 200, "LI", 1,
    (
        *_estimate(),
        Point("light_floor", "diffuse light", U16, _light("floor"), "Share of a lamp's RSS at its nadir.", 10_000),
        Point("sample_clock", "error of the sample clock", I16, _light("clock_ppm"),
          "Parts per million. Not known before lamps confirm it."),
        Point("blocks", "blocks of samples", U32, _count("blocks"), "Received since the start.", rule=Rule.WRAP,
              can_be_unknown=False),
        Point("blocks_lost", "unused blocks", U32, _count("blocks_lost"),
          "Dropped, damaged, or without a cycle to process them, since the start.", rule=Rule.WRAP,
          can_be_unknown=False),
        *(point for row in range(LISTED_LINKS) for point in _row(row)),
    ),
)  # fmt: skip
ROW_WORDS: Final = sum(point.wire.words for point in _row(0))
TAIL: Final = Layout(_estimate())
