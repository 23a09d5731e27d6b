"""Planar transforms: group laws, against matrices."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from estimator.measurements import Array
from estimator.numerics import se2

METRES = st.floats(-50.0, 50.0)
POSES = st.builds(lambda x, y, a: np.array((x, y, a)), METRES, METRES, st.floats(-3.1, 3.1))


def matrix(T: Array) -> Array:
    c, s = math.cos(T[2]), math.sin(T[2])
    return np.array(((c, -s, T[0]), (s, c, T[1]), (0.0, 0.0, 1.0)))


@given(POSES, POSES)
def test_compose_inverse_between(a: Array, b: Array) -> None:
    np.testing.assert_allclose(matrix(se2.compose(a, b)), matrix(a) @ matrix(b), atol=1e-9)
    np.testing.assert_allclose(matrix(se2.inverse(a)), np.linalg.inv(matrix(a)), atol=1e-9)
    np.testing.assert_allclose(matrix(se2.between(a, b)), np.linalg.inv(matrix(a)) @ matrix(b), atol=1e-9)


@given(POSES)
def test_exp_undoes_log(a: Array) -> None:
    np.testing.assert_allclose(matrix(se2.exp(se2.log(a))), matrix(a), atol=1e-7)


@given(POSES, st.integers(2, 9))
def test_a_twist_is_constant(a: Array, n: int) -> None:
    T = np.zeros(3)
    for _ in range(n):
        T = se2.compose(T, se2.exp(se2.log(a) / n))
    np.testing.assert_allclose(matrix(T), matrix(a), atol=1e-6)


@given(st.floats(-1e3, 1e3))
def test_wrap(angle: float) -> None:
    wrapped = se2.wrap(angle)
    assert -math.pi <= wrapped < math.pi
    assert math.isclose(math.sin(wrapped), math.sin(angle), abs_tol=1e-9)


@given(POSES, POSES)
def test_apply_is_compose_of_points(a: Array, b: Array) -> None:
    np.testing.assert_allclose(se2.apply(a, b[None, :2])[0], se2.compose(a, b)[:2], atol=1e-9)


def test_carry_swings_a_heading_error() -> None:
    """1 deg of heading is 17 mm sideways after one metre; against sampling."""
    rng = np.random.default_rng(0)
    P = np.diag((1e-4, 4e-4, 3e-4))
    a, b = np.array((3.0, -1.0, 0.7)), np.array((2.0, 0.5, 0.2))
    samples = np.array([se2.compose(a + e, b) for e in rng.multivariate_normal(np.zeros(3), P, 20_000)])
    np.testing.assert_allclose(np.cov(samples.T), se2.carry(a, b, P), atol=4e-5)
