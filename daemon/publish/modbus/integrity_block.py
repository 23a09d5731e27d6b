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
    ("laser_bounds", "the protection level uses the lidar solution", lambda s: s.trust.laser),
    ("light_bounds", "the protection level uses the light solution", lambda s: s.trust.light),
    ("wheels_bound", "the protection level uses odometry, which lidar and light share", lambda s: s.trust.wheels),
    ("alert", "the protection level is above the alert limit, or there is none", lambda s: s.trust.alert),
)


def _witnesses(snapshot: Snapshot) -> Value:
    return sum(1 << number for number, (_, _, test) in enumerate(WITNESSES) if test(snapshot))


def _gap(snapshot: Snapshot) -> Value:
    gap = snapshot.trust.gap
    return math.sqrt(gap) if gap is not None and gap >= 0.0 else None


_REASONS: Final = ", ".join(f"{reason.value} {reason.name}" for reason in LoopReason)
_BOUND: Final = "Rounded up; the largest value means this or more. Not known: there is no protection level."

POINTS: Final = (
    Point("protection", "protection level", U16, attrgetter("trust.horizontal_m"),
          f"Horizontal, of the map pose. {_BOUND}", 1_000, "m", ceil=True),
    Point("protection_yaw", "protection level of the heading", U16, attrgetter("trust.yaw_rad"), _BOUND, 10_000, "rad",
          ceil=True),
    Point("alert_limit", "alert limit", U16, attrgetter("trust.limit_m"),
          "`integrity.alert_m`. Not known: no limit is set.", 1_000, "m"),
    Point("witnesses", "solutions behind the protection level", U16, _witnesses, "Bits, see below.",
          can_be_unknown=False),
    Point("witness_gap", "normalised separation", U16, _gap,
          "Distance between pose and light solution, in standard deviations. Not known: one of them is missing.", 100),
    Point("places", "number of hypotheses", U16, attrgetter("trust.places"), "During relocalisation: 0 none yet, 1 "
        "waits for confirmation, more than 1 ambiguous. Not known: the pose is known."),
    Point("loop_reason", "loop closure, reason", U16, attrgetter("loop_reason"), f"{_REASONS}. Not known before the "
          "first."),
    Point("loop_residual", "loop closure, residual", U16, attrgetter("loop_residual"),
          "RMS distance of the inlier beams. Not known before the first.", 10_000, "m", ceil=True),
)  # fmt: skip

BLOCK: Final = Block("integrity", 340, "LP", 1, POINTS)
TAIL: Final = Layout(POINTS)
