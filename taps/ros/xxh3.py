"""XXH3, 128 bits, seed 0, with the default secret, after the xxHash specification (github.com/Cyan4973/xxHash, doc).

A publisher of rmw_zenoh derives its GID from it. Pure Python: one short text is hashed per publisher.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

_MASK: Final = (1 << 64) - 1
_P32: Final = (0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D)
_P64: Final = (0x9E3779B185EBCA87, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x85EBCA77C2B2AE63, 0x27D4EB2F165667C5)
_MIX1: Final = 0x165667919E3779F9
_MIX2: Final = 0x9FB21C651E98DF25
_SECRET: Final = bytes.fromhex(
    "b8fe6c3923a44bbe7c01812cf721ad1cded46de9839097db7240a4a4b7b3671f"
    "cb79e64eccc0e578825ad07dccff7221b8084674f743248ee03590e6813a264c"
    "3c2852bb91c300cb88d0658b1b532ea371644897a20df94e3819ef46a9deacd8a8"
    "fa763fe39c343ff9dcbbc7c70b4f1d8a51e04bcdb45931c89f7ec9d9787364ea"
    "c5ac8334d3ebc3c581a0fffa1363eb170ddd51b7f0da49d316552629d4689e2b"
    "16be587d47a1fc8ff8b8d17ad031ce45cb3a8f95160428afd7fbcabb4b407e"
)
_STRIPE: Final = 64
_STRIPES_PER_BLOCK: Final = 16
_SHORT, _MIDDLE, _LONG = 16, 128, 240
"""Lengths in bytes up to which each of the first three algorithms applies."""

Pair = tuple[int, int]
"""Low and high 64 bits."""


def xxh3_128(data: bytes) -> int:
    """The hash as a number of 128 bits."""
    if len(data) <= _SHORT:
        low, high = _short(data)
    elif len(data) <= _LONG:
        low, high = _middle(data)
    else:
        low, high = _long(data)
    return high << 64 | low


def _read(data: bytes, at: int, size: int = 8) -> int:
    return int.from_bytes(data[at : at + size], "little")


def _product(a: int, b: int) -> Pair:
    whole = a * b
    return whole & _MASK, whole >> 64


def _fold(a: int, b: int) -> int:
    low, high = _product(a, b)
    return low ^ high


def _swap(value: int, size: int = 8) -> int:
    return int.from_bytes(value.to_bytes(size, "little"), "big")


def _avalanche(value: int) -> int:
    value = (value ^ value >> 37) * _MIX1 & _MASK
    return value ^ value >> 32


def _avalanche64(value: int) -> int:
    """The final mix of XXH64."""
    value = (value ^ value >> 33) * _P64[1] & _MASK
    value = (value ^ value >> 29) * _P64[2] & _MASK
    return value ^ value >> 32


def _short(data: bytes) -> Pair:
    if len(data) > 8:
        return _from_9(data)
    if len(data) >= 4:
        return _from_4(data)
    if data:
        return _from_1(data)
    return _avalanche64(_read(_SECRET, 64) ^ _read(_SECRET, 72)), _avalanche64(_read(_SECRET, 80) ^ _read(_SECRET, 88))


def _from_1(data: bytes) -> Pair:
    size = len(data)
    low = data[0] << 16 | data[size >> 1] << 24 | data[-1] | size << 8
    turned = _swap(low, 4)
    high = (turned << 13 | turned >> 19) & 0xFFFFFFFF
    keys = [_read(_SECRET, at, 4) ^ _read(_SECRET, at + 4, 4) for at in (0, 8)]
    return _avalanche64(low ^ keys[0]), _avalanche64(high ^ keys[1])


def _from_4(data: bytes) -> Pair:
    size = len(data)
    whole = _read(data, 0, 4) | _read(data, size - 4, 4) << 32
    keyed = whole ^ _read(_SECRET, 16) ^ _read(_SECRET, 24)
    low, high = _product(keyed, _P64[0] + (size << 2))
    high = high + (low << 1) & _MASK
    low ^= high >> 3
    low = (low ^ low >> 35) * _MIX2 & _MASK
    return low ^ low >> 28, _avalanche(high)


def _from_9(data: bytes) -> Pair:
    size = len(data)
    flips = [_read(_SECRET, at) ^ _read(_SECRET, at + 8) for at in (32, 48)]
    first, last = _read(data, 0), _read(data, size - 8)
    low, high = _product(first ^ last ^ flips[0], _P64[0])
    low = low + (size - 1 << 54) & _MASK
    last ^= flips[1]
    high = high + last + (last & 0xFFFFFFFF) * (_P32[1] - 1) & _MASK
    low ^= _swap(high)
    low, more = _product(low, _P64[1])
    return _avalanche(low), _avalanche(more + high * _P64[1] & _MASK)


def _mix16(data: bytes, at: int, secret: int) -> int:
    return _fold(_read(data, at) ^ _read(_SECRET, secret), _read(data, at + 8) ^ _read(_SECRET, secret + 8))


def _mix32(now: Pair, data: bytes, one: int, other: int, secret: int) -> Pair:
    low, high = now
    low = low + _mix16(data, one, secret) & _MASK
    low ^= _read(data, other) + _read(data, other + 8) & _MASK
    high = high + _mix16(data, other, secret + 16) & _MASK
    return low, high ^ (_read(data, one) + _read(data, one + 8) & _MASK)


def _middle(data: bytes) -> Pair:
    size = len(data)
    now = size * _P64[0] & _MASK, 0
    if size <= _MIDDLE:
        for i in range((size - 1) // 32, -1, -1):
            now = _mix32(now, data, 16 * i, size - 16 * (i + 1), 32 * i)
    else:
        for i in range(4):
            now = _mix32(now, data, 32 * i, 32 * i + 16, 32 * i)
        now = _avalanche(now[0]), _avalanche(now[1])
        for i in range(4, size // 32):
            now = _mix32(now, data, 32 * i, 32 * i + 16, 3 + 32 * (i - 4))
        now = _mix32(now, data, size - 16, size - 32, 103)
    low, high = now
    mixed = low * _P64[0] + high * _P64[3] + size * _P64[1] & _MASK
    return _avalanche(low + high & _MASK), -_avalanche(mixed) & _MASK


def _accumulate(lanes: list[int], data: bytes, at: int, secret: int) -> None:
    for i in range(8):
        value = _read(data, at + 8 * i)
        key = value ^ _read(_SECRET, secret + 8 * i)
        lanes[i ^ 1] = lanes[i ^ 1] + value & _MASK
        lanes[i] = lanes[i] + (key & 0xFFFFFFFF) * (key >> 32) & _MASK


def _scramble(lanes: list[int]) -> None:
    for i, lane in enumerate(lanes):
        lanes[i] = (lane ^ lane >> 47 ^ _read(_SECRET, len(_SECRET) - _STRIPE + 8 * i)) * _P32[0] & _MASK


def _merged(lanes: Sequence[int], secret: int, start: int) -> int:
    for i in range(0, 8, 2):
        keys = _read(_SECRET, secret + 8 * i), _read(_SECRET, secret + 8 * i + 8)
        start += _fold(lanes[i] ^ keys[0], lanes[i + 1] ^ keys[1])
    return _avalanche(start & _MASK)


def _long(data: bytes) -> Pair:
    lanes = [_P32[2], _P64[0], _P64[1], _P64[2], _P64[3], _P32[1], _P64[4], _P32[0]]
    for stripe in range((len(data) - 1) // _STRIPE):
        _accumulate(lanes, data, _STRIPE * stripe, 8 * (stripe % _STRIPES_PER_BLOCK))
        if stripe % _STRIPES_PER_BLOCK == _STRIPES_PER_BLOCK - 1:
            _scramble(lanes)
    _accumulate(lanes, data, len(data) - _STRIPE, len(_SECRET) - _STRIPE - 7)
    high = ~(len(data) * _P64[1]) & _MASK
    low = _merged(lanes, 11, len(data) * _P64[0] & _MASK)
    return low, _merged(lanes, len(_SECRET) - _STRIPE - 11, high)
