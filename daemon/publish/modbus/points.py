"""Published point: wire type, scale, "not known" value, and encoding of one value.

Two rules apply to every point. A measurement *saturates* at the largest value of its type and never wraps. A counter
*wraps* modulo its width, because a reader takes differences of it and a saturated counter would stop.
"Not known" is the value SunSpec calls "not implemented": all ones for unsigned types, the smallest number for signed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from itertools import accumulate
from typing import Final

from daemon.snapshot import Snapshot

Value = int | float | None
"""A decoded point: SI units where the table gives a unit, None for the "not known" value."""

FLOAT32_MAX: Final = (2.0 - 2.0**-23) * 2.0**127


@dataclass(frozen=True, slots=True)
class Wire:
    """An integer type on the wire: its name in the documents, its `struct` letter, its width in bits."""

    name: str
    code: str
    bits: int
    signed: bool

    @property
    def words(self) -> int:
        """Number of 16-bit registers."""
        return self.bits // 16

    @property
    def not_known(self) -> int:
        """Smallest number of a signed type, all ones of an unsigned one."""
        return -(1 << (self.bits - 1)) if self.signed else (1 << self.bits) - 1

    @property
    def span(self) -> tuple[int, int]:
        """Smallest and largest raw value that a measurement can have: symmetric, and without the not-known value."""
        top = (1 << (self.bits - 1)) - 1 if self.signed else (1 << self.bits) - 2
        return (-top if self.signed else 0), top


U16: Final = Wire("uint16", "H", 16, signed=False)
I16: Final = Wire("int16", "h", 16, signed=True)
U32: Final = Wire("uint32", "I", 32, signed=False)
I32: Final = Wire("int32", "i", 32, signed=True)
U64: Final = Wire("uint64", "Q", 64, signed=False)


class Rule(Enum):
    """Treatment of a value that the type cannot represent."""

    SATURATE = "saturates"
    WRAP = "wraps"


@dataclass(frozen=True, slots=True)
class Point:
    """One value of the published block, after the model of a SunSpec point.

    Attributes:
        name: key in decoded readings and in the documents. label: short description for display.
        wire: integer type. value: getter from a snapshot, in `unit`; None or NaN: not known.
        per_unit: raw counts per `unit` (10 000 per m: 0.1 mm each). unit: SI, empty for numbers without one.
        rule: see :class:`Rule`. ceil: round up, for uncertainties, which must never be published too small.
        can_be_unknown: whether the not-known value has its meaning here. access: R or RW. text: for the documents.
    """

    name: str
    label: str
    wire: Wire
    value: Callable[[Snapshot], Value]
    text: str
    per_unit: int = 1
    unit: str = ""
    rule: Rule = Rule.SATURATE
    ceil: bool = False
    can_be_unknown: bool = True
    access: str = "R"

    def encode(self, value: Value) -> int:
        """Raw integer for a value in `unit`; NaN and None give the not-known value, infinities saturate."""
        return self.encoder()(value)

    def encoder(self) -> Callable[[Value], int]:
        """:meth:`encode` with everything precomputed that is the same for every value."""
        missing, modulus = self.wire.not_known if self.can_be_unknown else 0, 1 << self.wire.bits
        (low, high), scale, to_int = self.wire.span, self.per_unit, math.ceil if self.ceil else round

        def wrap(value: Value) -> int:
            return missing if value is None or value != value else int(value) % modulus

        def saturate(value: Value) -> int:
            if value is None or value != value:
                return missing
            scaled = value * scale
            return to_int(scaled) if low < scaled < high else high if scaled >= high else low

        return wrap if self.rule is Rule.WRAP else saturate

    def decode(self, raw: int) -> Value:
        """Value in `unit` for a raw integer."""
        if self.can_be_unknown and raw == self.wire.not_known:
            return None
        return raw if self.per_unit == 1 else raw / self.per_unit


def from_client(_: Snapshot) -> Value:
    """Getter of a point that clients write: a snapshot contains no value for it."""
    return None


@dataclass(frozen=True, slots=True)
class FloatPoint:
    """One value of the float32 mirror, in SI units; NaN: not known."""

    name: str
    label: str
    unit: str
    value: Callable[[Snapshot], Value]

    def encode(self, value: Value) -> float:
        """The value as float32; infinities and overflow saturate."""
        if value is None or value != value:
            return math.nan
        return max(-FLOAT32_MAX, min(FLOAT32_MAX, float(value)))


class Layout:
    """Consecutive points without gaps, encoded and decoded in either byte order."""

    def __init__(self, points: Sequence[Point]) -> None:
        self.points: Final = tuple(points)
        self.offsets: Final = tuple(accumulate((p.wire.words for p in self.points[:-1]), initial=0))
        self.words: Final = sum(p.wire.words for p in self.points)
        codes = "".join(p.wire.code for p in self.points)
        self.big: Final = struct.Struct(">" + codes)
        self.little: Final = struct.Struct("<" + codes)
        self._plan: Final = tuple((p.encoder(), p.value) for p in self.points)
        self._latest: tuple[Snapshot | None, tuple[int, ...]] = (None, ())

    def raw(self, snapshot: Snapshot) -> tuple[int, ...]:
        """Raw integers of a snapshot, in order; cached for the latest one, because several publishers use it."""
        if self._latest[0] is not snapshot:
            self._latest = snapshot, tuple([encode(value(snapshot)) for encode, value in self._plan])
        return self._latest[1]

    def values(self, raw: Iterable[int]) -> dict[str, Value]:
        """Decoded values by name."""
        return {p.name: p.decode(r) for p, r in zip(self.points, raw, strict=True)}
