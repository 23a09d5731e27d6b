"""Modbus block and pose datagram tail for integrity: protection level, alert, solutions behind it.

    Modbus    magic u16, version u16 | seq u32, POINTS, big-endian, high word first | seq_end u32     at 340
    datagram  POINTS, little-endian, behind the tail of :mod:`daemon.publish.modbus.lights_block`

The contract is that of the other tables: under the same version a point never moves and never changes its meaning.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from operator import attrgetter
from typing import Final

from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import U16, Layout, Point, Value
from daemon.snapshot import LoopReason, Snapshot

Bit = tuple[str, str, Callable[[Snapshot], bool]]

WITNESSES: Final[tuple[Bit, ...]] = (
    ("laser_bounds", "the bound rests on the laser", lambda s: s.trust.laser),
    ("light_bounds", "the bound rests on light", lambda s: s.trust.light),
    ("wheels_bound", "the bound rests on wheel odometry, which laser and light share", lambda s: s.trust.wheels),
    ("alert", "the bound is above the limit that is set, or there is none", lambda s: s.trust.alert),
)


def _witnesses(snapshot: Snapshot) -> Value:
    return sum(1 << number for number, (_, _, test) in enumerate(WITNESSES) if test(snapshot))


def _gap(snapshot: Snapshot) -> Value:
    gap = snapshot.trust.gap
    return math.sqrt(gap) if gap is not None and gap >= 0.0 else None


_REASONS: Final = ", ".join(f"{reason.value} {reason.name}" for reason in LoopReason)
_BOUND: Final = "Rounded up; the largest value means this or more. Not known: there is no bound, the error may be any."

POINTS: Final = (
    Point("protection", "protection level", U16, attrgetter("trust.horizontal_m"), "Bound on the horizontal error of "
          f"the map pose. {_BOUND}", 1_000, "m", ceil=True),
    Point("protection_yaw", "protection level of the heading", U16, attrgetter("trust.yaw_rad"), _BOUND, 10_000, "rad",
          ceil=True),
    Point("alert_limit", "alert limit", U16, attrgetter("trust.limit_m"), "`integrity.alert_m`. Not known: none is "
          "set.", 1_000, "m"),
    Point("witnesses", "what the bound rests on", U16, _witnesses, "Bits, see below.", can_be_unknown=False),
    Point("witness_gap", "gap between the witnesses", U16, _gap, "Distance between the pose and the one from light "
          "alone, in standard deviations. Not known: one of them is missing.", 100),
    Point("places", "places that fit", U16, attrgetter("trust.places"), "While the place is looked for: 0 none yet, 1 "
          "is being confirmed, more than 1 ambiguous. Not known: the place is known."),
    Point("loop_reason", "loop closure, why", U16, attrgetter("loop_reason"), f"{_REASONS}. Not known before the "
          "first."),
    Point("loop_residual", "loop closure, residual", U16, attrgetter("loop_residual"), "RMS distance of the beams that "
          "fit. Not known before the first.", 10_000, "m", ceil=True),
)  # fmt: skip

BLOCK: Final = Block("integrity", 340, "LP", 1, POINTS)
TAIL: Final = Layout(POINTS)
