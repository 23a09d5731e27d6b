"""Simulated I2C chips, byte by byte as in their data sheets.

MCP3221 (Microchip DS20001732), ADC121C021 (TI SNAS415), ADS1015 and ADS1115 (TI SBAS473, SBAS444), and two other chips
at the same addresses: the LM75 thermometer and a 24C02 EEPROM.

Not modelled: noise and non-linearity (left to the source), alert pins, Hs-mode, the general call.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import Final, Protocol

import numpy as np
import numpy.typing as npt

from hal.fake.adc.i2c_timing import SclTiming, Times

SampleSource = Callable[[Times], npt.NDArray[np.float64]]
"""Maps ``t_mono`` of conversions, ascending, to the input voltages as fractions of the supply.

It is called at the end of the transaction, so that all times lie in the past. Values beyond 0 to 1 clip in the
converter.
"""

T_ACQUIRE_S: Final = 1.12e-6
"""MCP3221: from the edge that starts a conversion to the opening of the sample switch."""
_AIN1: Final = 5
"""ADS1x15: multiplexer code of AIN1 against ground."""
STALE_S: Final = 0.1
"""After this long without a conversion the first one is the sample from the end of the last transaction."""


class FakeChip(Protocol):
    """A chip on the bus.

    Attributes:
        acknowledges_data: whether it acknowledges the bytes of a write, or its address only.
    """

    acknowledges_data: bool

    def power_on(self, t_mono: float) -> None:
        """Reset the chip."""
        ...

    def write(self, data: bytes, t_mono: float) -> None:
        """Process a write message."""
        ...

    def read(self, length: int, line: SclTiming) -> bytes:
        """Answer a read message."""
        ...


def _codes(fractions: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Codes of 12 bits, straight binary."""
    return np.clip(np.floor(4096.0 * np.nan_to_num(fractions)), 0, 4095).astype(np.int64)


class _SarConverter:
    """A successive-approximation converter clocked by SCL: conversion k begins 8 + 18 k clocks after START."""

    def __init__(self, source: SampleSource) -> None:
        self._source = source
        self._t_last = float("-inf")

    def rest(self) -> None:
        """Drop the held sample (power-on)."""
        self._t_last = float("-inf")

    def convert(self, length: int, line: SclTiming) -> npt.NDArray[np.int64]:
        count = (length + 1) // 2
        times = line.times(8 + 18 * np.arange(count)) + T_ACQUIRE_S
        stale = times[0] - self._t_last > STALE_S
        requested = times.copy()
        if stale and math.isfinite(self._t_last):
            requested[0] = self._t_last
        self._t_last = line.time(10 + 9 * length)
        return _codes(self._source(requested))


def _words(codes: npt.NDArray[np.int64], length: int) -> bytes:
    pairs = np.stack([codes >> 8, codes & 0xFF], axis=1)
    return pairs.astype(np.uint8).tobytes()[:length]


class Mcp3221:
    """The MCP3221, without registers: a write address is acknowledged, the bytes after it are not."""

    acknowledges_data = False

    def __init__(self, source: SampleSource) -> None:
        self._converter = _SarConverter(source)

    def power_on(self, t_mono: float) -> None:
        """Drop the held sample."""
        self._converter.rest()

    def write(self, data: bytes, t_mono: float) -> None:
        """Device polling (6.3): only the address is acknowledged."""

    def read(self, length: int, line: SclTiming) -> bytes:
        """Conversions ``0000 D11..D8``, ``D7..D0``, repeated."""
        return _words(self._converter.convert(length, line), length)


class Adc121c021:
    """The ADC121C021, with eight registers behind a pointer; a read of the conversion register converts."""

    acknowledges_data = True
    _SIZES: Final = (2, 1, 1, 2, 2, 2, 2, 2)
    _RESET: Final = (0x0000, 0x00, 0x00, 0x0000, 0x0FFF, 0x0000, 0x0FFF, 0x0000)
    _READ_ONLY: Final = (0,)

    def __init__(self, source: SampleSource) -> None:
        self._converter = _SarConverter(source)
        self.power_on(0.0)

    def power_on(self, t_mono: float) -> None:
        """Pointer at the conversion result, normal mode."""
        self._converter.rest()
        self.pointer = 0
        self.registers = list(self._RESET)

    def write(self, data: bytes, t_mono: float) -> None:
        """Pointer, then the register's bytes, the high one first."""
        self.pointer = data[0] & 7
        size = self._SIZES[self.pointer]
        if len(data) > size and self.pointer not in self._READ_ONLY:
            self.registers[self.pointer] = int.from_bytes(data[1 : 1 + size], "big")

    def read(self, length: int, line: SclTiming) -> bytes:
        """The selected register, repeated; conversions where it is the conversion register."""
        if self.pointer:
            size = self._SIZES[self.pointer]
            value = self.registers[self.pointer].to_bytes(size, "big")
            return (value * (length // size + 1))[:length]
        codes = self._converter.convert(length, line)
        self.registers[6] = min(self.registers[6], int(codes.min()))
        self.registers[7] = max(self.registers[7], int(codes.max()))
        flagged = self.registers[2] & 0b1000 and self._alert(codes)
        return _words(codes | (0x8000 if flagged else 0), length)

    def _alert(self, codes: npt.NDArray[np.int64]) -> bool:
        return bool(codes.min() < self.registers[3] or codes.max() > self.registers[4])


class Ads1x15:
    """An ADS1015 or ADS1115: a delta-sigma converter with an oscillator of its own.

    Args:
        source: fractions of the supply ``supply_v``. bits: 16 for an ADS1115, 12 for an ADS1015.
        oscillator: relative error of its data rate, up to 0.1.

    Attributes:
        second_v: voltage at the input AIN1; None: as at the others.
    """

    acknowledges_data = True
    _FULL_SCALE: Final = (6.144, 4.096, 2.048, 1.024, 0.512, 0.256, 0.256, 0.256)
    _RATES: Final = {
        12: (128, 250, 490, 920, 1600, 2400, 3300, 3300),
        16: (8, 16, 32, 64, 128, 250, 475, 860),
    }

    def __init__(self, source: SampleSource, bits: int = 16, supply_v: float = 3.3, oscillator: float = 0.0) -> None:
        self._source, self._bits, self._supply_v, self._oscillator = source, bits, supply_v, oscillator
        self.second_v: float | None = None
        self.power_on(0.0)

    def power_on(self, t_mono: float) -> None:
        """Single-shot mode, idle, thresholds at the ends."""
        self.pointer = 0
        self.config = 0x8583
        self.low, self.high = 0x8000, 0x7FFF
        self._held, self._since, self._ready = 0, t_mono, math.inf

    def write(self, data: bytes, t_mono: float) -> None:
        """Pointer, then a 16-bit register."""
        self.pointer = data[0] & 3
        if len(data) < 3:
            return
        value = int.from_bytes(data[1:3], "big")
        if self.pointer == 1:
            self._configure(value, t_mono)
        elif self.pointer == 2:
            self.low = value
        elif self.pointer == 3:
            self.high = value

    def read(self, length: int, line: SclTiming) -> bytes:
        """The selected register, repeated."""
        value = (self._result(line.t_start), self._state(line.t_start), self.low, self.high)[self.pointer]
        return (struct.pack(">H", value) * (length // 2 + 1))[:length]

    def _period(self) -> float:
        return 1.0 / (self._RATES[self._bits][self.config >> 5 & 7] * (1.0 + self._oscillator))

    def _configure(self, value: int, t_mono: float) -> None:
        self._held = self._result(t_mono)
        running = self._period() if not self.config & 0x0100 else 0.0
        self.config = value
        starts = not value & 0x0100 or value & 0x8000
        self._since = t_mono + running
        self._ready = self._since + self._period() if starts else math.inf

    def _state(self, t_mono: float) -> int:
        converting = not self.config & 0x0100 or t_mono < self._ready < math.inf
        return (self.config & 0x7FFF) | (0 if converting else 0x8000)

    def _result(self, t_mono: float) -> int:
        """Content of the conversion register: the latest complete conversion."""
        if t_mono < self._ready:
            return self._held
        period = self._period()
        done = 1 if self.config & 0x0100 else math.floor((t_mono - self._since) / period)
        volts = float(self._source(np.array([self._since + (done - 0.5) * period]))[0]) * self._supply_v
        if self.second_v is not None and self.config >> 12 & 7 == _AIN1:
            volts = self.second_v
        steps = round(volts / self._FULL_SCALE[self.config >> 9 & 7] * 32768.0)
        value = min(max(steps, -32768), 32767)
        return (value & (0xFFF0 if self._bits == 12 else 0xFFFF)) & 0xFFFF


class _Registers:
    """A chip with registers and no function."""

    acknowledges_data = True

    def __init__(self, reset: dict[int, bytes], pointer_mask: int) -> None:
        self._reset, self._mask = reset, pointer_mask
        self.power_on(0.0)

    def power_on(self, t_mono: float) -> None:
        self.pointer, self.values = 0, dict(self._reset)

    def write(self, data: bytes, t_mono: float) -> None:
        self.pointer = data[0] & self._mask
        if len(data) > 1:
            self.values[self.pointer] = data[1:]

    def read(self, length: int, line: SclTiming) -> bytes:
        value = self.values.get(self.pointer, b"\xff")
        return (value * length)[:length]


class Lm75(_Registers):
    """A thermometer at 0x48 to 0x4F, at 25 degrees."""

    def __init__(self) -> None:
        super().__init__({0: b"\x19\x00", 1: b"\x00", 2: b"\x4b\x00", 3: b"\x50\x00"}, 3)


class Eeprom24c02(_Registers):
    """An erased memory at 0x50 to 0x57."""

    def __init__(self) -> None:
        super().__init__({}, 0xFF)
