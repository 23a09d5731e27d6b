"""The compiled filter against textbook matrices, and its covariance against time."""

import dataclasses

import numpy as np
import pytest

from estimator.light_filter import measurement_update, state_vector
from estimator.light_filter.lambertian import expected, pack_lamps, pack_receiver
from estimator.light_filter.survey import Survey
from estimator.measurements import Array
from estimator.numerics import se2
from tests.estimator.light_room import LAMPS, RECEIVER

N = state_vector.FIRST + state_vector.OWN * len(LAMPS)
BACK = np.array((0.03, -0.01, 0.04))
MODEL = (0.03, 0.5, 0.005, 0.08)


def state(seed: int) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    x, P = np.zeros(state_vector.SIZE), np.zeros((state_vector.SIZE, state_vector.SIZE))
    x[:3] = 5.0 + rng.normal(0, 0.5), 5.0 + rng.normal(0, 0.5), rng.uniform(-3, 3)
    x[3:N] = 0.02 * rng.standard_normal(N - 3)
    x[state_vector.FLOOR] = np.log(0.015)
    root = 0.03 * rng.standard_normal((N, N)) + np.diag(np.full(N, 0.05))
    P[:N, :N] = root @ root.T
    return x, P


def lamp_table() -> Array:
    table = np.zeros((state_vector.SLOTS, 7))
    table[: len(LAMPS)] = pack_lamps(LAMPS, 0.3)
    return table


def view() -> Array:
    return np.concatenate([pack_receiver(RECEIVER), BACK, MODEL])


def links_of(x: Array, slots: list[int], seed: int) -> Array:
    rng = np.random.default_rng(seed)
    pose = se2.compose(x[:3], BACK)
    seen = expected([LAMPS[k] for k in slots], Survey(LAMPS, RECEIVER), pose).amplitude
    rows = [
        (k, np.log(a) + 0.01 * rng.standard_normal(), 1e-4, 0.01, -1.0, 0.0, 0.0)
        for k, a in zip(slots, seen, strict=True)
    ]
    return np.array(rows)


def slow_row(x: Array, link: Array) -> tuple[float, Array, float]:
    """Residual, Jacobian over the whole state and noise of one link, by finite differences of the optics."""

    def predicted(z: Array) -> float:
        receiver = RECEIVER.__class__(
            x=RECEIVER.x,
            y=RECEIVER.y,
            z=RECEIVER.z,
            order=RECEIVER.order + float(z[state_vector.ORDER]),
            slope_x=float(z[state_vector.LEAN_X]),
            slope_y=float(z[state_vector.LEAN_Y]),
        )
        pose = se2.compose(z[:3], BACK)
        k = int(link[measurement_update.SLOT])
        own = state_vector.FIRST + state_vector.OWN * k
        gain, lean_x, lean_y, error = z[own : own + 4].tolist()
        lamp = dataclasses.replace(LAMPS[k], slope_x=lean_x, slope_y=lean_y)
        seen = expected([lamp], Survey(LAMPS, receiver), pose, float(np.exp(z[state_vector.FLOOR])))
        direct = seen.direct[0] / seen.amplitude[0]
        scale = np.sqrt(
            MODEL[0] ** 2
            + ((1 - direct) * MODEL[1]) ** 2
            + (MODEL[3] * (np.tan(seen.beta_rad[0]) / np.tan(RECEIVER.half_fov_rad)) ** 4) ** 2
        )
        return float(
            np.log(seen.amplitude[0]) + link[measurement_update.SHIFT] + z[state_vector.COMMON] + gain + scale * error
        )

    H = np.zeros(N)
    for j in range(N):
        step = np.zeros(state_vector.SIZE)
        step[j] = 1e-5
        H[j] = (predicted(x + step) - predicted(x - step)) / 2e-5
    return float(link[measurement_update.LN] - predicted(x)), H, float(link[measurement_update.NOISE] + MODEL[2] ** 2)


@pytest.mark.parametrize("seed", range(3))
def test_links_are_taken_in_as_by_the_textbook(seed: int) -> None:
    x, P = state(seed)
    links = links_of(x, [5, 6, 9, 10, 14], seed)
    out = np.zeros((len(links), measurement_update.OUT_COLUMNS))
    measurement_update.linearise(x, P, links, lamp_table(), view(), out)
    rows = [slow_row(x, link) for link in links]
    r, H, R = np.array([k[0] for k in rows]), np.array([k[1] for k in rows]), np.diag([k[2] for k in rows])
    np.testing.assert_allclose(out[:, measurement_update.RESIDUAL], r, atol=1e-9)
    np.testing.assert_allclose(out[:, measurement_update.SPREAD], np.diag(H @ P[:N, :N] @ H.T), rtol=2e-2)
    got_x, got_P = x.copy(), P.copy()
    likelihood, nis = measurement_update.absorb(got_x, got_P, N, x.copy(), links, out)
    for i, link in enumerate(links):  # the twin uses the kernels' derivatives, which leave out d(scale)/d(place)
        H[i] = 0.0
        for w in range(measurement_update.WIDTH):
            H[i, measurement_update.element(link[measurement_update.SLOT], w)] = out[i, measurement_update.SLOPES + w]
    S = H @ P[:N, :N] @ H.T + R
    K = np.linalg.solve(S, H @ P[:N, :N]).T
    I_KH = np.eye(N) - K @ H
    np.testing.assert_allclose(got_x[:N], x[:N] + K @ r, atol=1e-9)
    np.testing.assert_allclose(got_P[:N, :N], I_KH @ P[:N, :N] @ I_KH.T + K @ R @ K.T, atol=1e-11)
    want = -0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(2 * np.pi * S)[1])
    assert likelihood == pytest.approx(want, abs=1e-6)
    assert nis == pytest.approx(r @ np.linalg.solve(S, r), rel=1e-6)


def test_slopes_of_a_link_are_its_derivatives() -> None:
    x, P = state(7)
    links = links_of(x, [5, 6, 9], 7)
    out = np.zeros((3, measurement_update.OUT_COLUMNS))
    x[state_vector.FIRST + state_vector.ERROR : N : state_vector.OWN] = (
        0.0  # at model errors of zero the scale's own derivative does not matter
    )
    measurement_update.linearise(x, P, links, lamp_table(), view(), out)
    for i, link in enumerate(links):
        H = slow_row(x, link)[1]
        for w in range(measurement_update.WIDTH):
            want = H[measurement_update.element(link[measurement_update.SLOT], w)]
            assert out[i, measurement_update.SLOPES + w] == pytest.approx(want, abs=1e-6), w


def test_a_link_with_infinite_noise_changes_nothing() -> None:
    x, P = state(1)
    links = links_of(x, [5, 6], 1)
    out = np.zeros((2, measurement_update.OUT_COLUMNS))
    measurement_update.linearise(x, P, links, lamp_table(), view(), out)
    out[:, measurement_update.WHITE] = np.inf
    got_x, got_P = x.copy(), P.copy()
    assert measurement_update.absorb(got_x, got_P, N, x.copy(), links, out) == (0.0, 0.0)
    np.testing.assert_array_equal(got_P, P)
    np.testing.assert_array_equal(got_x, x)


def slow_move(x: Array, delta: Array, blame: Array) -> Array:
    z = x.copy()
    scale = 1 + blame[6] * x[state_vector.SCALE]
    add = blame[2:6] @ x[[state_vector.TURN, state_vector.TURN_SCALE, state_vector.CURVE, state_vector.GYRO]]
    u, v = scale * delta[0] + blame[0] * x[state_vector.SPEED], scale * delta[1] + blame[1] * x[state_vector.SIDE]
    u, v = u - 0.5 * add * v, v + 0.5 * add * u
    z[:3] = se2.compose(x[:3], np.array((u, v, delta[2] + add)))
    return z


@pytest.mark.parametrize("seed", range(4))
def test_a_motion_is_propagated_as_by_the_textbook(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x, P = state(seed)
    delta, blame = rng.normal(0, 0.1, 3), rng.normal(0, 0.1, 7)
    noise = np.array((1e-4, 4e-4, 9e-4))
    F = np.zeros((N, N))
    for j in range(N):
        step = np.zeros(state_vector.SIZE)
        step[j] = 1e-6
        diff = slow_move(x + step, delta, blame) - slow_move(x - step, delta, blame)
        F[:, j] = diff[:N] / 2e-6
    R = se2.rotation(x[2])[:3, :3]
    Q = np.zeros((N, N))
    Q[:3, :3] = R @ np.diag(noise) @ R.T
    got_x, got_P = x.copy(), P.copy()
    state_vector.move(got_x, got_P, N, delta, blame, noise)
    np.testing.assert_allclose(got_x, slow_move(x, delta, blame), atol=1e-12)
    np.testing.assert_allclose(got_P[:N, :N], F @ P[:N, :N] @ F.T + Q, atol=2e-6)


def test_fading_and_cutting() -> None:
    x, P = state(2)
    keep, grow = np.ones(N), np.zeros(N)
    keep[state_vector.FIRST + 3], grow[state_vector.FIRST + 3], grow[state_vector.COMMON] = 0.5, 0.75, 1e-3
    D = np.diag(keep)
    got_x, got_P = x.copy(), P.copy()
    state_vector.fade(got_x, got_P, N, keep, grow)
    np.testing.assert_allclose(got_P[:N, :N], D @ P[:N, :N] @ D + np.diag(grow), atol=1e-15)
    np.testing.assert_allclose(got_x[:N], keep * x[:N])
    state_vector.cut(got_P, N, 4)
    off = np.delete(got_P[4, :N], 4)
    np.testing.assert_array_equal(off, 0.0)
    np.testing.assert_array_equal(np.delete(got_P[:N, 4], 4), 0.0)


@pytest.mark.jit
def test_covariance_stays_symmetric_and_positive_over_ten_thousand_epochs() -> None:
    rng = np.random.default_rng(5)
    x, P = state(5)
    keep, grow = np.ones(N), np.zeros(N)
    (
        keep[state_vector.FIRST + state_vector.ERROR : N : state_vector.OWN],
        grow[state_vector.FIRST + state_vector.ERROR : N : state_vector.OWN],
    ) = 0.99, 1 - 0.99**2
    out = np.zeros((8, measurement_update.OUT_COLUMNS))
    for _ in range(10_000):
        state_vector.move(
            x, P, N, np.array((0.01, 0.0, 0.02)), np.array((0, 0, 0, 0.02, 0.01, 0, 1.0)), np.full(3, 1e-8)
        )
        state_vector.fade(x, P, N, keep, grow)
        x[:2] = 5.0 + rng.normal(0, 1.0, 2)  # pulled about, so that the derivatives keep changing
        x[3:N] *= 0.5
        x[state_vector.FLOOR] = np.log(0.015)
        links = links_of(x, list(rng.permutation(16)[:8]), 1)
        measurement_update.linearise(x, P, links, lamp_table(), view(), out)
        measurement_update.absorb(x, P, N, x.copy(), links, out)
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P[:N, :N]).min() > -1e-12
