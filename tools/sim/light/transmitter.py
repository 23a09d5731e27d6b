"""What a coded ceiling lamp sends: chips and data bits, built another way than the decoder builds them.

The decoder makes its codes with shift registers; here they are traces of powers of a field element, which is what Gold
proved his theorem with (Gold, IEEE Trans. Inf. Theory 13, 1967): u(t) = Tr(a^t), v(t) = u(q t), and the codes are
u + T^k v, u and v. Frames are written as strings of '0' and '1', and the CRC is a polynomial division by hand.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FIELD = {6: 0b1000011, 7: 0b10001001, 9: 0b1000010001}
"""Primitive polynomial of GF(2^n)."""

DECIMATION = {6: 5, 7: 3, 9: 3}
"""q = 2^k + 1 with n / gcd(n, k) odd: the two sequences are a preferred pair."""

SYNC = "1110101110010000"
CRC_POLYNOMIAL = 0b10001000000100001


def _times_alpha(element: int, degree: int) -> int:
    element <<= 1
    return element ^ FIELD[degree] if element >> degree else element


def _times(a: int, b: int, degree: int) -> int:
    product = 0
    while b:
        if b & 1:
            product ^= a
        a, b = _times_alpha(a, degree), b >> 1
    return product


def _trace(element: int, degree: int) -> int:
    """Tr(x) = x + x^2 + x^4 + ..., which is 0 or 1."""
    total = 0
    for _ in range(degree):
        total ^= element
        element = _times(element, element, degree)
    assert total in (0, 1)
    return total


@cache
def code_bits(degree: int, number: int) -> tuple[int, ...]:
    """Chips of one code as bits; 2^n + 1 codes of 2^n - 1 chips."""
    length = 2**degree - 1
    powers = [1]
    while len(powers) < length:
        powers.append(_times_alpha(powers[-1], degree))
    u = [_trace(power, degree) for power in powers]
    v = [u[DECIMATION[degree] * t % length] for t in range(length)]
    if number == length:
        return tuple(u)
    if number == length + 1:
        return tuple(v)
    if not 0 <= number < length:
        raise ValueError(f"code {number} does not exist: degree {degree} has codes 0..{length + 1}")
    return tuple(u[t] ^ v[(t + number) % length] for t in range(length))


def _field(value: int, width: int) -> str:
    """Two's complement where negative."""
    if not -(2 ** (width - 1)) <= value < 2**width:
        raise ValueError(f"{value} does not fit into {width} bits")
    return format(value % 2**width, f"0{width}b")


def _remainder(message: str) -> str:
    """CRC-16 of a bit string: polynomial 0x1021, register starts at all ones."""
    bits = [int(bit) for bit in message + 16 * "0"]
    bits[:16] = [1 - bit for bit in bits[:16]]
    for at in range(len(message)):
        if bits[at]:
            for k in range(17):
                bits[at + k] ^= CRC_POLYNOMIAL >> (16 - k) & 1
    return "".join(map(str, bits[-16:]))


@dataclass(frozen=True)
class Lamp:
    """One lamp as the simulated world knows it.

    Attributes:
        code: number of its spreading code. lamp_id: its own number in the building.
        position_m: (x, y, z) of the lamp. power_w: radiant power. half_angle_deg: 0 = not told.
        ppm: crystal error. phase_chips: chip phase at time 0.
        current_a: mean photocurrent it causes at the receiver; depth: modulation depth.
        slope_a_s: change of that current per second (a robot that drives).
    """

    code: int
    current_a: float
    lamp_id: int = 0
    position_m: tuple[float, float, float] = (0.0, 0.0, 2.6)
    power_w: float = 1.5
    half_angle_deg: int = 70
    depth: float = 0.30
    ppm: float = 0.0
    phase_chips: float = 0.0
    slope_a_s: float = 0.0
    data: bool = True

    def frame(self) -> str:
        """The 116 bits it repeats for ever."""
        if not self.data:
            return "0"
        x, y, z = self.position_m
        payload = _field(0, 2) + _field(self.lamp_id, 16)
        payload += _field(round(x / 0.005), 18) + _field(round(y / 0.005), 18) + _field(round(z / 0.005), 12)
        payload += _field(round(self.power_w / 0.01), 11) + _field(self.half_angle_deg, 7)
        return SYNC + payload + _remainder(_field(self.code, 16) + payload)

    def edges(self, begin: float, end: float, chip_rate: float, degree: int) -> tuple[Array, Array]:
        """Times of all half-chip edges within [begin, end] and the jump of photocurrent at each, the first from 0.

        Manchester: chip 0 is bright then dark, chip 1 dark then bright; data bit 1 exchanges them for a code period.
        """
        rate = 2.0 * chip_rate * (1.0 + 1e-6 * self.ppm)
        start = int(np.ceil(begin * rate + 2.0 * self.phase_chips))
        stop = int(np.floor(end * rate + 2.0 * self.phase_chips))
        half = np.arange(start, stop + 1)
        when = (half - 2.0 * self.phase_chips) / rate
        chips = np.array(code_bits(degree, self.code))
        frame = np.array([int(bit) for bit in self.frame()])
        chip = half // 2
        bright = (half + chips[chip % len(chips)] + frame[chip // len(chips) % len(frame)]) % 2 == 0
        current = self.current_a + self.slope_a_s * when
        level = current * np.where(bright, 1.0 + self.depth, 1.0 - self.depth)
        return when, np.diff(level, prepend=0.0)


@dataclass(frozen=True)
class PwmLamp:
    """A dimmed lamp that carries no code: on and off at one frequency.

    Attributes:
        hertz: frequency. swing_a: photocurrent while it is on. duty: share of the time. phase: of the rise, cycles.
    """

    hertz: float
    swing_a: float
    duty: float = 0.5
    phase: float = 0.0

    @property
    def current_a(self) -> float:
        """Mean photocurrent."""
        return self.swing_a * self.duty

    def edges(self, begin: float, end: float) -> tuple[Array, Array]:
        """Times of all edges within [begin, end] and the jump of photocurrent at each."""
        cycles = np.arange(np.ceil(begin * self.hertz), np.floor(end * self.hertz) + 1.0)
        rise = (cycles + self.phase % 1.0) / self.hertz
        when = np.concatenate((rise, rise + self.duty / self.hertz))
        jump = np.repeat((self.swing_a, -self.swing_a), len(rise))
        inside = when <= end
        return when[inside], jump[inside]
