"""Gold codes: spreading codes that distinguish the ceiling lamps (R. Gold, IEEE Trans. Inf. Theory 13, 1967).

A preferred pair of m-sequences u, v of length L = 2^n - 1 gives L + 2 codes. Number k < L is u + T^k v (v shifted left
by k, sum modulo 2). Number L is u, number L + 1 is v. Off-peak correlations take three values only. The largest is
t(n) / L with t = 2^((n+1)/2) + 1 for odd n and 2^((n+2)/2) + 1 for even n: 0.27 (n = 6), 0.134 (7), 0.065 (9).
"""

from __future__ import annotations

from functools import cache
from typing import Final

import numpy as np
import numpy.typing as npt

Chips = npt.NDArray[np.float64]

PREFERRED: Final[dict[int, tuple[int, int]]] = {
    6: (0b1000011, 0b1100111),
    7: (0b10001001, 0b10001111),
    9: (0b1000010001, 0b1001011001),
}
"""Feedback polynomials of u and v, bit k standing for x^k (octal 103/147, 211/217, 1021/1131)."""


def characteristic_fill(polynomial: int, degree: int) -> list[int]:
    """First ``degree`` bits of the one phase of an m-sequence for which s(2t) = s(t), by Newton's identities."""
    coefficient = [polynomial >> (degree - k) & 1 for k in range(degree + 1)]
    fill = [degree % 2]
    for k in range(1, degree):
        known = sum(coefficient[i] * fill[k - i] for i in range(1, k))
        fill.append((known + k * coefficient[k]) % 2)
    return fill


def m_sequence(polynomial: int, degree: int) -> npt.NDArray[np.int64]:
    """Maximum-length sequence of bits in its characteristic phase, length ``2**degree - 1``."""
    bits = characteristic_fill(polynomial, degree)
    taps = [k for k in range(degree) if polynomial >> k & 1]
    while len(bits) < 2**degree - 1:
        bits.append(sum(bits[len(bits) - degree + k] for k in taps) % 2)
    return np.array(bits)


@cache
def gold_codes(degree: int) -> Chips:
    """All codes of one degree as chips, shape (2**degree + 1, 2**degree - 1); bit 0 is +1, bit 1 is -1.

    Raises:
        ValueError: no preferred pair is defined for that degree.
    """
    if degree not in PREFERRED:
        raise ValueError(f"no Gold codes of degree {degree}; degrees {sorted(PREFERRED)} exist")
    u, v = (m_sequence(polynomial, degree) for polynomial in PREFERRED[degree])
    shifted = [u ^ np.roll(v, -k) for k in range(len(u))]
    chips = 1.0 - 2.0 * np.array([*shifted, u, v])
    return chips
