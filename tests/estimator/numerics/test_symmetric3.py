"""The small solvers against numpy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.numerics.symmetric3 import (
    TINY,
    add_turned,
    det3,
    eigen3,
    invert3,
    largest_of,
    positive,
    positive_part,
    solve3,
    swing,
)

NUMBERS = st.floats(-3.0, 3.0).map(lambda x: x if abs(x) > 1e-12 else 0.0)
"""Without those whose squares vanish: numpy's answers, the reference here, err in the fourth digit with them."""
FACTORS = arrays(np.float64, (3, 3), elements=NUMBERS)
SCALES = st.sampled_from([(1.0, 1.0, 1.0), (1e3, 1e-2, 1.0), (1.0, 1.0, 1e-4)])


def spd(factor: Array, scale: tuple[float, float, float]) -> Array:
    s = np.diag(scale)
    return np.ascontiguousarray(s @ (factor @ factor.T + 0.1 * np.eye(3)) @ s)


@given(FACTORS, SCALES, arrays(np.float64, 3, elements=st.floats(-5.0, 5.0)))
@settings(deadline=None)
def test_solve(factor: Array, scale: tuple[float, float, float], b: Array) -> None:
    A, x = spd(factor, scale), np.empty(3)
    det = solve3(A, b, x)
    assert det == pytest.approx(np.linalg.det(A), rel=1e-6)
    np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-6, atol=1e-6)


def test_solve_refuses_what_is_singular() -> None:
    x = np.ones(3)
    assert solve3(np.diag((1.0, 1.0, 0.0)), np.ones(3), x) == 0.0
    assert not x.any()
    assert solve3(np.full((3, 3), np.nan), np.ones(3), x) == 0.0


@given(FACTORS)
@settings(deadline=None)
def test_eigen(factor: Array) -> None:
    A = np.ascontiguousarray(factor + factor.T)
    D, V = A.copy(), np.empty((3, 3))
    eigen3(D, V)
    np.testing.assert_allclose(np.sort(np.diag(D)), np.linalg.eigvalsh(A), atol=1e-9)
    np.testing.assert_allclose(V @ V.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(V @ np.diag(np.diag(D)) @ V.T, A, atol=1e-9)


@given(FACTORS)
@settings(deadline=None)
def test_positive(factor: Array) -> None:
    A = np.ascontiguousarray(factor + factor.T)
    least = np.linalg.eigvalsh(A)[0]
    if abs(least) > 1e-6:
        assert positive(A) == (least > 0.0)


@given(FACTORS, SCALES)
@settings(deadline=None)
def test_invert(factor: Array, scale: tuple[float, float, float]) -> None:
    A = spd(factor, scale)
    exact = np.linalg.inv(A + TINY * np.eye(3))
    d = np.sqrt(np.diag(exact))
    np.testing.assert_allclose(invert3(A) / d / d[:, None], exact / d / d[:, None], atol=1e-4)


def test_invert_is_finite_for_nothing_and_for_one_direction() -> None:
    assert np.isfinite(invert3(np.zeros((3, 3)))).all()
    line = np.outer((1.0, 2.0, 0.0), (1.0, 2.0, 0.0))
    assert np.isfinite(invert3(line)).all()


@given(FACTORS)
@settings(deadline=None)
def test_positive_part_and_determinant(factor: Array) -> None:
    A = np.ascontiguousarray(factor + factor.T)
    values, vectors = np.linalg.eigh(A)
    np.testing.assert_allclose(positive_part(A), (vectors * np.maximum(values, 0.0)) @ vectors.T, atol=1e-9)
    assert det3(factor) == pytest.approx(np.linalg.det(factor), abs=1e-9)


@given(FACTORS, FACTORS, SCALES)
@settings(deadline=None)
def test_largest_eigenvalue_of_a_product(factor: Array, other: Array, scale: tuple[float, float, float]) -> None:
    G, P = np.ascontiguousarray(other + other.T), spd(factor, scale)
    whole = np.linalg.eigvals(G @ P).real
    assert largest_of(G, P) == pytest.approx(whole.max(), abs=1e-7 * np.abs(whole).max() + 1e-12)


@given(FACTORS, st.floats(-4.0, 4.0), st.tuples(*[st.floats(0.0, 2.0)] * 3))
@settings(deadline=None)
def test_lever_arm_and_turned_noise(factor: Array, yaw: float, variance: tuple[float, float, float]) -> None:
    P = factor.copy()
    swing(0.7, -0.3, P)
    F = np.array(((1.0, 0.0, 0.3), (0.0, 1.0, 0.7), (0.0, 0.0, 1.0)))
    np.testing.assert_allclose(P, F @ factor @ F.T, atol=1e-12)
    add_turned(yaw, np.array(variance), P)
    R = se2.rotation(yaw)
    np.testing.assert_allclose(P, F @ factor @ F.T + (R * np.array(variance)) @ R.T, atol=1e-12)


def test_eigenvalues_with_next_to_nothing_beside_them() -> None:
    """Known without a reference: 0 and -0.75, 0.75 whatever stands beside them so small."""
    A = np.array(((0.0, 5.9e-161, 0.0), (5.9e-161, 0.0, 0.75), (0.0, 0.75, 0.0)))
    values = positive_part(A)
    np.testing.assert_allclose(np.linalg.eigvalsh(values), (0.0, 0.0, 0.75), atol=1e-9)
