"""The kernels of the pose's covariance against the same in numpy, product by product."""

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.numerics.covariance3 import carry_on, feel_axes, grow_tie, hang, informed, mend_tie, turn
from estimator.numerics.symmetric3 import invert3


def covariance(rng: np.random.Generator) -> Array:
    A = rng.normal(size=(3, 3)) * (0.1, 0.1, 0.02)
    return np.asarray(A.T @ A + 1e-4 * np.eye(3))


def swing(x: float, y: float, P: Array) -> Array:
    F = np.array(((1.0, 0.0, -y), (0.0, 1.0, x), (0.0, 0.0, 1.0)))
    return np.asarray(F @ P @ F.T)


@pytest.fixture(params=range(5))
def rng(request: pytest.FixtureRequest) -> np.random.Generator:
    return np.random.default_rng(request.param)


def test_a_pose_is_carried_on_with_the_noise_of_its_motion(rng: np.random.Generator) -> None:
    T, delta, variance, P = rng.normal(size=3) * 2.0, rng.normal(size=3), rng.uniform(0.1, 1.0, 3), covariance(rng)
    T_out, P_out = np.empty(3), np.empty((3, 3))
    carry_on(T, delta, variance, P, T_out, P_out)
    R = se2.rotation(T[2] + 0.5 * delta[2])
    assert T_out == pytest.approx(se2.compose(T, delta), abs=1e-12)
    assert P_out == pytest.approx(se2.carry(T, delta, P) + R @ np.diag(variance) @ R.T, abs=1e-12)


def test_a_velocity_is_felt_axis_by_axis(rng: np.random.Generator) -> None:
    velocity, spread, made = rng.normal(size=3), rng.uniform(0.1, 1.0, 3), rng.normal(size=3)
    variance, unknown = rng.uniform(0.1, 1.0, 3), rng.uniform(0.5, 2.0, 3)
    P = spread + unknown * 0.3**2
    gain = P / (P + variance / 0.2**2 + unknown * 0.25 * 0.2**2)
    expected = velocity + gain * (made / 0.2 - velocity)
    feel_axes(velocity, spread, made, variance, unknown, (0.2, 0.3))
    assert velocity == pytest.approx(expected, abs=1e-12)
    assert spread == pytest.approx((1.0 - gain) * P, abs=1e-12)


def test_the_tie_grows_by_the_noise_that_the_pose_has_taken_on(rng: np.random.Generator) -> None:
    P, X, before, after, out = *(covariance(rng) for _ in range(4)), np.empty((2, 3, 3))
    made = np.array((0.3, -0.2, 1e-3, 2e-3, 3e-3))
    grow_tie(P, X, before, after, made, out)
    Q = after - swing(0.3, -0.2, before)
    assert out[0] == pytest.approx(swing(0.3, -0.2, P) + Q + np.diag(made[2:]), abs=1e-12)
    assert out[1] == pytest.approx(swing(0.3, -0.2, X) + Q, abs=1e-12)


def test_the_tie_is_mended_as_far_as_its_error_is_the_poses(rng: np.random.Generator) -> None:
    before, H, out = covariance(rng), invert3(covariance(rng)), np.empty((3, 3, 3))
    X = rng.normal(size=(3, 3)) @ before
    P, more = X @ invert3(before) @ X.T + covariance(rng), 0.5 * before
    after = invert3(invert3(before + more) + H)
    mend_tie(P, X, more, before, after, out)
    share = (X + more) @ invert3(before + more)
    mended = P + more - share @ (before + more - after) @ share.T
    assert out[2] == pytest.approx(share, rel=1e-9, abs=1e-9)
    assert out[0] == pytest.approx(0.5 * (mended + mended.T), rel=1e-9, abs=1e-9)
    assert out[1] == pytest.approx(share @ after, rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("scale", [1.001, 2.0, 1e3])
def test_no_match_takes_more_from_the_ties_error_than_there_is(rng: np.random.Generator, scale: float) -> None:
    """An ``X`` too large for the two covariances, as late scans may leave it; the match leaves nearly no error."""
    before, out = covariance(rng), np.empty((3, 3, 3))
    X = scale * rng.normal(size=(3, 3)) @ before
    P, nothing = X @ invert3(before) @ X.T / scale**2, np.zeros((3, 3))
    P += 1e-9 * np.eye(3)
    mend_tie(P, X, nothing, before, 0.01 * before, out)
    assert np.linalg.eigvalsh(out[0]).min() > -1e-9 * np.trace(P)
    joint = np.block([[out[0], out[1]], [out[1].T, 0.01 * before]])
    size = np.sqrt(np.diag(joint))
    assert np.linalg.eigvalsh(joint / np.outer(size, size)).min() > -1e-6
    share = X @ invert3(before)
    assert np.linalg.eigvalsh(out[0]).min() > 0.0, "something is always left"
    assert out[2] == pytest.approx(share * (out[2][0, 0] / share[0, 0]), rel=1e-6, abs=1e-9), "in the same directions"


def test_covariances_turn_hang_and_take_information_in(rng: np.random.Generator) -> None:
    P, of_anchor, yaw, out = covariance(rng), covariance(rng), float(rng.normal()), np.empty((3, 3))
    R = se2.rotation(yaw)
    turn(P, yaw, out)
    assert out == pytest.approx(R @ P @ R.T, abs=1e-12)
    anchor, T = rng.normal(size=3), rng.normal(size=3)
    hang(anchor, T, of_anchor, P, yaw, out)
    x, y, _ = T - anchor
    assert out == pytest.approx(R @ (swing(x, y, of_anchor) + P) @ R.T, abs=1e-12)
    informed(P, of_anchor, out)
    assert out == pytest.approx(invert3(invert3(P) + of_anchor), rel=1e-9)
