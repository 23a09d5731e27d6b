"""A kernel that looks at one element, wherever it is told to: for the test of the index check."""

from estimator.measurements import Array
from estimator.numerics.jit import kernel


@kernel("f8(f8[::1], i8)")
def element(values: Array, i: int) -> float:
    """One value of an array."""
    return float(values[i])
