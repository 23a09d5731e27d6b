"""Gold codes: built with shift registers here, from a finite field in the simulator, and both the same."""

import numpy as np
import pytest

from estimator.cdma.gold_codes import gold_codes
from tools.sim.light.transmitter import code_bits


@pytest.mark.parametrize("degree", [6, 7, 9])
def test_registers_and_field_give_the_same_codes(degree: int) -> None:
    codes = gold_codes(degree)
    assert codes.shape == (2**degree + 1, 2**degree - 1)
    for number in range(0, len(codes), 7 if degree == 9 else 1):
        np.testing.assert_array_equal(codes[number], 1 - 2 * np.array(code_bits(degree, number)))


@pytest.mark.parametrize(("degree", "largest"), [(6, 17), (7, 17), (9, 33)])
def test_correlations_take_the_three_values_of_gold(degree: int, largest: int) -> None:
    codes = gold_codes(degree)
    spectra = np.fft.rfft(codes)
    values: set[int] = set()
    for k in range(0, len(codes), 1 if degree < 9 else 16):
        correlation = np.round(np.fft.irfft(spectra * spectra[k].conj(), codes.shape[1])).astype(int)
        correlation[k, 0] = -1  # itself
        values |= set(np.unique(correlation).tolist())
    assert values == {-1, -largest, largest - 2}


def test_as_many_balanced_codes_as_theory_says() -> None:
    sums = gold_codes(7).sum(axis=1)
    assert np.count_nonzero(np.abs(sums) == 1) == 65


def test_no_other_degrees() -> None:
    with pytest.raises(ValueError, match=r"degree 8; degrees \[6, 7, 9\] exist"):
        gold_codes(8)
