"""Measures an I2C adapter: the longest read without a pause, and the SCL frequency.

Lengths are tried upwards, so that a request never exceeds the adapter's limit by much. (Some adapters then need a
time-out, and the next transaction fails as well.) A length is good when the read succeeds and takes no longer than
theory. USB adapters read in pieces and stop SCL between them.
"""

from __future__ import annotations

import asyncio
import errno
import os
from dataclasses import dataclass
from statistics import median
from typing import Final

from hal.bus.i2c import MAX_LENGTH, AsyncBus, read
from hal.errors import DeviceRefused
from hal.photodiode.timebase import SHORT, scl_hz

LENGTHS: Final = (60, 512, 2048, MAX_LENGTH)
_REPEATS: Final = {SHORT: 16, 60: 8, 512: 5}
_REPEATS_LONG: Final = 3
_PAUSE: Final = 0.03
"""A read that exceeds theory by more than this share contains a pause."""
_UNFIT: Final = {
    "i2c-gpio": "the processor clocks this bus in software, with interruptions",
    "FT260": "USB: it reads 60 bytes at a time and pauses",
    "MCP2221": "USB: it reads 60 bytes at a time and pauses",
    "CP2112": "USB: it reads 61 bytes at a time and pauses",
    "CH341": "USB: it reads 32 bytes at a time and pauses",
}
"""Adapters, by a part of their names, with unevenly spaced samples: usable for levels, not for decoding lights."""
_LIMITS: Final = frozenset({errno.EOPNOTSUPP, errno.EINVAL, errno.ETIMEDOUT, errno.EIO, errno.EPROTO})
_PASSING: Final = frozenset({errno.ENXIO, errno.EREMOTEIO, errno.EAGAIN, errno.EIO})
_FAILURES: Final = 3
_AGAIN_S: Final = 0.01
_SCL_HZ: Final = (10e3, 5e6)


@dataclass(frozen=True, slots=True)
class AdapterLimits:
    """Measured limits of an adapter.

    Attributes:
        length: bytes of the blocks to read. span_s, short_s: shortest read of that length, and of 2 bytes.
        spread_s: median excess of a 2-byte read over the shortest one.
        limit: why blocks are shorter than wanted or unevenly sampled; empty where neither holds.
    """

    length: int
    span_s: float
    short_s: float
    spread_s: float = 0.0
    limit: str = ""

    @property
    def scl_hz(self) -> float:
        """Measured SCL frequency."""
        return scl_hz(self.length, self.span_s, self.short_s)


async def _spans(bus: AsyncBus, address: int, length: int) -> list[float]:
    """Durations of several reads (s), the shortest first; raises `OSError` where one fails repeatedly."""
    spans: list[float] = []
    failures = 0
    while len(spans) < _REPEATS.get(length, _REPEATS_LONG):
        try:
            done = await bus.transfer((read(address, length),))
            if len(done.reads[0]) < length:
                raise OSError(errno.EIO, f"{len(done.reads[0])} of {length} bytes")
            spans.append(done.t1 - done.t0)
            failures = 0
        except OSError as error:
            failures += 1
            if error.errno not in _PASSING or failures > _FAILURES:
                raise
            await asyncio.sleep(_AGAIN_S)
    return sorted(spans)


async def measure(bus: AsyncBus, address: int, block_s: float) -> AdapterLimits:
    """Find the longest read up to ``block_s`` seconds without a pause.

    Raises:
        OSError: short reads fail. DeviceRefused: the adapter cannot read 60 bytes in one transaction.
    """
    shorts = await _spans(bus, address, SHORT)
    short_s, spread_s = shorts[0], median(shorts) - shorts[0]
    found: AdapterLimits | None = None
    limit = ""
    for length in LENGTHS:
        if found is not None:
            length = min(length, _wanted(block_s, found.scl_hz))
            if length <= found.length:
                break
        tried, limit = await _try(bus, address, length, short_s, found)
        if tried is None:
            break
        found = tried
    if found is None:
        raise DeviceRefused(
            bus.name,
            f"adapter {bus.about} cannot read {LENGTHS[0]} bytes at once ({limit})",
            "end other readers of this bus; without any, use an I2C controller of the processor",
        )
    wanted = min(_wanted(block_s, found.scl_hz), MAX_LENGTH)
    shorter = limit if found.length < wanted else ""
    unfit = next((why for name, why in _UNFIT.items() if name in bus.about), "")
    return AdapterLimits(found.length, found.span_s, short_s, spread_s, "; ".join(filter(None, (unfit, shorter))))


def _wanted(block_s: float, hz: float) -> int:
    """Bytes of whole words that fill ``block_s``."""
    return 2 * max(2, round(block_s * hz / 18.0))


async def _try(
    bus: AsyncBus, address: int, length: int, short_s: float, before: AdapterLimits | None
) -> tuple[AdapterLimits | None, str]:
    """Measure one length: its limits, or None and why it is too long."""
    try:
        span, *_ = await _spans(bus, address, length)
    except OSError as error:
        if error.errno not in _LIMITS:
            raise
        await _send_stop(bus, address)
        return None, f"{length} bytes: {os.strerror(error.errno or 0)}"
    tried = AdapterLimits(length, span, short_s)
    if not _SCL_HZ[0] < tried.scl_hz < _SCL_HZ[1]:
        return None, f"{length} bytes in {1e3 * span:.2f} ms, 2 bytes in {1e3 * short_s:.2f} ms"
    if before is not None and tried.scl_hz < (1.0 - _PAUSE) * before.scl_hz:
        return None, f"it pauses inside {length} bytes"
    return tried, ""


async def _send_stop(bus: AsyncBus, address: int) -> None:
    """Make a short read after a failed long one: it sends a STOP, and may itself fail once."""
    for _ in range(2):
        try:
            await bus.transfer((read(address, SHORT),))
            return
        except OSError:
            continue
