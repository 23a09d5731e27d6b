"""Data link: frame of lamp ID, position, height and power, with encoder, decoder and CRC.

One bit per code period, sent by inverting the code; a lamp repeats its frame for ever. The frame carries the paper's
coded information T = (x, y, i), with height and power. The layout is in docs/air-interface.md.
"""

from __future__ import annotations

from binascii import crc_hqx
from dataclasses import dataclass
from typing import Final

VERSION: Final = 0
SYNC: Final = 0xEB90
SYNC_BITS: Final = 16
CRC_BITS: Final = 16

FIELDS: Final = (
    ("version", 2, 1.0, False),
    ("lamp_id", 16, 1.0, False),
    ("x_m", 18, 0.005, True),
    ("y_m", 18, 0.005, True),
    ("z_m", 12, 0.005, False),
    ("power_w", 11, 0.01, False),
    ("half_angle_deg", 7, 1.0, False),
)
"""Name, width in bits, unit of the last bit, two's complement; in the order sent, most significant bit first."""

PAYLOAD_BITS: Final = sum(width for _, width, _, _ in FIELDS)
FRAME_BITS: Final = SYNC_BITS + PAYLOAD_BITS + CRC_BITS
"""116 bits: 2.946 s with profile A."""


@dataclass(frozen=True, slots=True)
class LampFrame:
    """Content of a lamp's data frame: the paper's T = (x, y, i), its height, and its radiation.

    Attributes:
        lamp_id: its number in the building (codes are reused, this is not). x_m, y_m, z_m: in the survey's frame.
        power_w: mean radiant power. half_angle_deg: angle of half intensity, 0 where not given.
    """

    lamp_id: int
    x_m: float
    y_m: float
    z_m: float
    power_w: float
    half_angle_deg: float = 0.0
    version: int = VERSION


def crc16(bits: int, width: int) -> int:
    """CRC-16/CCITT-FALSE (polynomial 0x1021, starts at 0xFFFF, no reflection, no final inversion) of a bit string."""
    register = 0xFFFF
    for _ in range(-width % 8):  # so that the zero bits that fill the first byte lead to the start value
        register = (register ^ 0x1021) >> 1 | 0x8000 if register & 1 else register >> 1
    return crc_hqx(bits.to_bytes((width + 7) // 8, "big"), register)


def _checksum(payload: int, code: int) -> int:
    """CRC of payload and code number. The number is not sent, but a frame received on a wrong code fails."""
    return crc16(code << PAYLOAD_BITS | payload, 16 + PAYLOAD_BITS)


def encode(frame: LampFrame, code: int) -> int:
    """Frame as an integer of FRAME_BITS bits, most significant bit sent first.

    Raises:
        ValueError: a value does not fit its field.
    """
    payload = 0
    for name, width, unit, signed in FIELDS:
        value = round(getattr(frame, name) / unit)
        low, high = (-(1 << width - 1), (1 << width - 1) - 1) if signed else (0, (1 << width) - 1)
        if not low <= value <= high:
            raise ValueError(f"{name} = {getattr(frame, name)} does not fit: {low * unit:g} to {high * unit:g}")
        payload = payload << width | value & (1 << width) - 1
    return (SYNC << PAYLOAD_BITS | payload) << CRC_BITS | _checksum(payload, code)


def _payload(bits: int) -> LampFrame:
    """Fields of a payload."""
    values: dict[str, float] = {}
    for name, width, unit, signed in reversed(FIELDS):
        value = bits & (1 << width) - 1
        bits >>= width
        values[name] = (value - (1 << width) if signed and value >> width - 1 else value) * unit
    lamp_id, version = int(values.pop("lamp_id")), int(values.pop("version"))
    return LampFrame(lamp_id=lamp_id, version=version, **values)


_SYNC_TEXT: Final = f"{SYNC:0{SYNC_BITS}b}"


def decode_ring(ring: int, code: int) -> LampFrame | None:
    """Decode the frame in FRAME_BITS consecutive bits that may begin anywhere in it; None if there is none.

    Inverted bits are tried as well, for a receiver that inverts the light. Frames of another version are ignored.
    """
    whole = (1 << FRAME_BITS) - 1
    for word in (ring, ring ^ whole):
        bits = f"{word:0{FRAME_BITS}b}"
        round_and_on = bits + bits[: SYNC_BITS - 1]
        turn = round_and_on.find(_SYNC_TEXT)
        while turn >= 0:
            turned = word << turn & whole | word >> FRAME_BITS - turn
            payload = turned >> CRC_BITS & (1 << PAYLOAD_BITS) - 1
            if turned & 0xFFFF == _checksum(payload, code) and payload >> PAYLOAD_BITS - 2 == VERSION:
                return _payload(payload)
            turn = round_and_on.find(_SYNC_TEXT, turn + 1)
    return None
