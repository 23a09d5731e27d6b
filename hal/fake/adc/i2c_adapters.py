"""Properties of I2C adapters under Linux: limits, errnos, overheads and pauses of a transaction.

Overheads differ between hosts; these are of the right order.
"""

from __future__ import annotations

import errno
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Adapter:
    """One adapter.

    Attributes:
        name: its own name. scl_hz: configured SCL. nack: errno of a missing acknowledgement.
        any_error: errno of every failed transfer, 0: each failure has its own.
        max_read, max_write, max_messages: beyond them EOPNOTSUPP. one_read_last: a read must be the only one, and last.
        chunk: bytes after which SCL pauses for chunk_pause_s; 0: never.
        timeout_s: a longer transaction fails. fails_after_timeout: the next one fails as well.
        start_s, end_s: from the call to START, from STOP to the return. jitter_s: mean of an exponential part of each.
        preempt_s: mean pause of SCL when a bit-banging processor is interrupted, every preempt_every_s on average.
    """

    name: str
    scl_hz: float = 400e3
    nack: int = errno.EREMOTEIO
    any_error: int = 0
    max_read: int = 8192
    max_write: int = 8192
    max_messages: int = 42
    one_read_last: bool = False
    chunk: int = 0
    chunk_pause_s: float = 0.0
    timeout_s: float = 1.0
    fails_after_timeout: bool = False
    start_s: float = 40e-6
    end_s: float = 25e-6
    jitter_s: float = 3e-6
    preempt_s: float = 0.0
    preempt_every_s: float = 0.0


BCM2835: Final = Adapter("bcm2835 (i2c@7e804000)", nack=errno.EREMOTEIO, one_read_last=True, fails_after_timeout=True)
"""Raspberry Pi 1 to 4."""
DESIGNWARE: Final = Adapter("Synopsys DesignWare I2C adapter", nack=errno.EREMOTEIO)
"""Raspberry Pi 5 (RP1) and many others."""
I2C_GPIO: Final = Adapter("i2c-gpio", nack=errno.ENXIO, scl_hz=100e3, preempt_s=50e-6, preempt_every_s=4e-3)
FT260: Final = Adapter(
    "FT260 usb-i2c bridge", any_error=errno.EIO, chunk=60, chunk_pause_s=1e-3, max_messages=2, start_s=1e-3, end_s=1e-3
)
MCP2221: Final = Adapter(
    "MCP2221 usb-i2c bridge", nack=errno.ENXIO, chunk=60, chunk_pause_s=1e-3, max_messages=2, start_s=1e-3, end_s=1e-3
)
CP2112: Final = Adapter(
    "CP2112 SMBus Bridge", nack=errno.ENXIO, max_read=512, max_write=61, max_messages=2, chunk=61,
    chunk_pause_s=1e-3, scl_hz=100e3, start_s=1e-3, end_s=1e-3,
)  # fmt: skip
CH341: Final = Adapter(
    "CH341 I2C USB", nack=errno.EREMOTEIO, max_read=128, max_write=128, chunk=32, chunk_pause_s=1e-3,
    scl_hz=100e3, start_s=1e-3, end_s=1e-3,
)  # fmt: skip
ADAPTERS: Final = {
    "bcm2835": BCM2835,
    "designware": DESIGNWARE,
    "i2c-gpio": I2C_GPIO,
    "ft260": FT260,
    "mcp2221": MCP2221,
    "cp2112": CP2112,
    "ch341": CH341,
}
