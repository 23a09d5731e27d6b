"""The MCP3221 converter: 12 bits, one input, no registers (Microchip DS20001732).

A read gives ``0000 D11..D8``, ``D7..D0`` for as long as the host acknowledges; full scale is the supply,
code = 4096 Vin / VDD. The first conversion begins with the falling SCL edge after the R/W bit, every further one with
the falling edge of the previous result's last bit (5.3.1, 5.3.3). A write address is acknowledged (device polling,
6.3), but there is nothing to write to, and data bytes are not.
"""

from __future__ import annotations

from typing import Final

from hal.photodiode.chips import BlockChip, Query

ADDRESSES: Final = frozenset(range(0x48, 0x50))
"""By part number, A0 to A7; A5 (0x4D) is the common one."""
_POINTER: Final = Query(b"\x01", 2)


def mismatch(answers: tuple[bytes | None, ...]) -> str:
    """Text where the chip accepts a register number and returns bits that are always zero in an MCP3221."""
    (answer,) = answers
    if answer is None or len(answer) < 2 or not answer[0] & 0xF0:
        return ""
    return f"has registers (number 1 reads {int.from_bytes(answer, 'big'):#06x}), an MCP3221 has none"


CHIP: Final = BlockChip(
    name="MCP3221",
    addresses=ADDRESSES,
    bits=12,
    spare=0xF000,
    scl_max_hz=400e3,
    queries=(_POINTER,),
    mismatch=mismatch,
)
