"""The paper's light filter: its prediction, update and start against slow twins, and when it gives no pose."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.fusion.motion_model import MotionNoise, odometry_variance
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import Array, Odometry
from estimator.numerics import se2
from estimator.paper.light_pose import BASE_M, STALE_S, LightPose
from estimator.result import Fix
from tests.estimator.paper.lamps import SURVEY, epoch_at, receiver_at

NOISE = MotionNoise()
START = np.array((1.0, 1.0, 0.6))
STEP = np.array((0.03, 0.0, 0.012))
"""A step of the wheels every 50 ms."""


def fresh() -> LightPose:
    return LightPose(LightsSetup(SURVEY, clock_ppm=0.0), NOISE)


def drive(light: LightPose, steps: int, T: Array, t: float = 0.0, codes: range = range(9)) -> tuple[Array, float]:
    """Exact wheels and exact epochs, in turn; the pose and instant at the end."""
    for _ in range(steps):
        light.receive(Odometry(t, t + 0.05, STEP))
        T, t = se2.compose(T, STEP), t + 0.05
        light.receive(replace(epoch_at(T, t, codes), t_begin=t, t_end=t))
    return T, t


def test_the_start_brings_the_wheels_onto_the_places() -> None:
    """Eq. 13 on exact places gives the true pose as soon as the way is long enough, and not before."""
    light, steps = fresh(), 0
    T, t = START, 0.0
    while not light.aligned:
        assert light.result.fix in (Fix.NONE, Fix.STARTING)
        assert light.virtual(t) is None
        T, t = drive(light, 1, T, t)
        steps += 1
    driven = math.dist(receiver_at(T), receiver_at(START))
    assert BASE_M < driven < BASE_M + 0.5
    np.testing.assert_allclose(light.T, T, atol=1e-5)
    assert light.result.fix is Fix.GOOD
    seen = light.virtual(t)
    assert seen is not None
    np.testing.assert_allclose(seen.T_map_base, T, atol=1e-5)
    assert len(seen.accepted) == 4


def test_a_way_that_does_not_fit_the_places_is_no_start() -> None:
    """Wheels that report a small circle while the robot drives straight on."""
    light = fresh()
    for k in range(17):
        light.receive(Odometry(0.05 * k, 0.05 * k + 0.05, np.array((0.1, 0.0, 0.19))))
        light.receive(epoch_at(np.array((0.25 * k, 2.0, 0.0)), 0.05 * k + 0.05))
    assert math.dist(light.T[:2], (0.0, 0.0)) > BASE_M
    assert not light.aligned


def test_without_movement_there_is_no_heading() -> None:
    light = fresh()
    for k in range(40):
        light.receive(epoch_at(START, 0.05 * k))
    assert not light.aligned
    assert light.result.fix is Fix.STARTING


def test_the_prediction_is_that_of_a_numerical_jacobian() -> None:
    light, rng = fresh(), np.random.default_rng(2)
    light.T, A = np.array((1.0, -2.0, 0.9)), rng.normal(0.0, 0.1, (3, 3))
    light.P = A @ A.T
    delta = np.array((0.3, -0.1, 0.2))
    F = numeric(lambda T: se2.compose(T, delta), light.T)
    G = numeric(lambda d: se2.compose(light.T, d), np.zeros(3))
    expected = F @ light.P @ F.T + G @ np.diag(odometry_variance(delta, 0.05, NOISE)) @ G.T
    T = se2.compose(light.T, delta)
    light.predict(Odometry(0.0, 0.05, delta))
    np.testing.assert_allclose(light.P, expected, atol=1e-7)
    np.testing.assert_allclose(light.T, T)
    np.testing.assert_allclose(light.at(0.05), T)
    np.testing.assert_allclose(se2.between(T, light.at(0.1)), delta, atol=1e-12)


def test_the_update_is_the_kalman_update_in_information_form() -> None:
    """Eq. 5-7 by the book: ``P'^-1 = P^-1 + J' Q^-1 J``, ``x' = x + P' J' Q^-1 (z - h(x))``."""
    light = fresh()
    T, t = drive(light, 60, START)
    light.T, light.P = light.T + np.array((0.1, -0.05, 0.04)), np.diag((0.02, 0.03, 0.01))
    before, P = light.T, light.P
    light.receive(replace(epoch_at(T, t), t_begin=t, t_end=t))
    position = light.selection.position
    assert position is not None
    J = numeric(lambda T: receiver_at(T), before)
    np.testing.assert_allclose(position.xy, receiver_at(T), atol=1e-6)
    Q = np.linalg.inv(position.covariance)
    after = np.linalg.inv(np.linalg.inv(P) + J.T @ Q @ J)
    np.testing.assert_allclose(light.P, after, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(light.T, before + after @ J.T @ Q @ (position.xy - receiver_at(before)), atol=1e-7)


def test_an_epoch_is_compared_with_where_the_robot_was() -> None:
    """An epoch is true for its middle; a robot that has driven on since is not pulled back."""
    light = fresh()
    T, t = drive(light, 60, START)
    light.receive(Odometry(t, t + 0.05, STEP))
    light.receive(epoch_at(T, t))
    np.testing.assert_allclose(light.T, se2.compose(T, STEP), atol=1e-4)


def test_too_few_links_pause_it_and_wheels_carry_it_on() -> None:
    light = fresh()
    T, t = drive(light, 60, START)
    P = light.P
    T, t = drive(light, 20, T, t, range(3))
    assert light.result.fix is Fix.HELD
    assert light.result.accepted == frozenset()
    assert light.virtual(t) is None
    np.testing.assert_allclose(light.T, T, atol=1e-4)
    assert np.trace(light.P) > np.trace(P)
    T, t = drive(light, 1, T, t)
    assert light.result.fix is Fix.GOOD
    assert light.virtual(t) is not None
    assert light.virtual(t + 1.1 * STALE_S) is None, "light that has gone out says nothing"


def test_misfit_is_of_the_links_at_the_pose() -> None:
    light = fresh()
    assert light.misfit() == 0.0
    drive(light, 60, START)
    fits = light.misfit()
    assert fits == pytest.approx(0.0, abs=1e-3)
    light.T = light.T + np.array((0.8, 0.0, 0.0))
    assert light.misfit() > 1.0


@pytest.mark.parametrize(
    "record", [Odometry(0.1, 0.1, STEP), Odometry(0.2, 0.1, STEP), Odometry(0.0, 0.1, np.array((np.nan, 0.0, 0.0)))]
)
def test_wheels_that_say_nothing_move_nothing(record: Odometry) -> None:
    light = fresh()
    light.receive(record)
    np.testing.assert_array_equal(light.T, np.zeros(3))
    np.testing.assert_array_equal(light.P, np.zeros((3, 3)))


def numeric(f, x: Array) -> Array:  # type: ignore[no-untyped-def]
    """Jacobian by central differences."""
    steps = 1e-6 * np.eye(len(x))
    return np.column_stack([(f(x + d) - f(x - d)) / 2e-6 for d in steps])
