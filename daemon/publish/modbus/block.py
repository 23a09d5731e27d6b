"""Modbus register block beside the first one: layout, encoding and decoding of one whole snapshot.

    Modbus    magic u16, version u16 | seq u32, points, big-endian, high word first | seq_end u32

One request reads the whole block. Under the same version a point never moves and never changes its meaning.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from operator import attrgetter
from typing import Final

from daemon.publish.modbus.points import U32, Layout, Point, Rule, Value
from daemon.snapshot import Snapshot

_HEAD: Final = struct.Struct(">HH")
_END: Final = struct.Struct(">I")
_SEQ: Final = Point(
    "seq", "snapshot number", U32, attrgetter("seq"), "The same as in the first block.", rule=Rule.WRAP,
    can_be_unknown=False,
)  # fmt: skip


class Block(Layout):
    """Address, points and encoding of a block.

    Attributes:
        name: of its content, for messages. address: of its first register. magic, version: its first two registers.
        body: address of the first point, the snapshot's number. registers: number of registers.
    """

    def __init__(self, name: str, address: int, tag: str, version: int, points: Sequence[Point]) -> None:
        super().__init__((_SEQ, *points))
        self.name: Final = name
        self.address: Final = address
        self.magic: Final = int.from_bytes(tag.encode(), "big")
        self.version: Final = version
        self.body: Final = address + _HEAD.size // 2
        self.registers: Final = self.words + (_HEAD.size + _END.size) // 2

    def encode(self, snapshot: Snapshot) -> bytes:
        """The input registers at :attr:`address`."""
        raw = self.raw(snapshot)
        return _HEAD.pack(self.magic, self.version) + self.big.pack(*raw) + _END.pack(raw[0])

    def decode(self, block: bytes) -> dict[str, Value]:
        """Values by name.

        Raises:
            ValueError: not this block, a version this decoder does not know, or torn (seq differs at its ends).
        """
        if len(block) != 2 * self.registers:
            raise ValueError(f"the block of {self.name} has {self.registers} registers, got {len(block) / 2:g}")
        magic, version = _HEAD.unpack_from(block)
        if magic != self.magic or version != self.version:
            known = f"this reader needs {self.magic:#06x} and {self.version}"
            raise ValueError(f"magic {magic:#06x} and version {version} of the block of {self.name}; {known}")
        raw = self.big.unpack_from(block, _HEAD.size)
        (seq_end,) = _END.unpack_from(block, len(block) - _END.size)
        if raw[0] != seq_end:
            torn = f"seq is {raw[0]} at its begin and {seq_end} at its end"
            raise ValueError(f"torn block: {torn}; read it in one request")
        return self.values(raw)
