"""Wheel scale, track and laser mount come out of a drive with honest sigmas, and what was not driven is not told."""

import numpy as np
import pytest

from estimator.calibration.odometry_calibration import Wheel, fit_wheels
from estimator.numerics.se2 import between, compose

TRUE = np.array((1.02, 0.97, 0.004, 0.31, -0.06, 0.05))


def drive(seed: int, turns: bool = True, n: int = 3000) -> tuple[np.ndarray, np.ndarray]:
    """What the wheels sum up and where the laser was, at the same instants."""
    g = np.random.default_rng(seed)
    t = 0.05 * np.arange(n)
    rate = 0.5 * np.sin(0.21 * t) + 0.4 * np.sin(0.057 * t + 1) if turns else np.zeros(n)
    base, wheels = np.zeros(3), np.zeros(3)
    said, seen = [], []
    for k in range(n):
        moved = np.array((0.025, 0.0, 0.05 * rate[k]))
        base = compose(base, moved)
        way = moved[0] / TRUE[Wheel.SCALE]
        yaw = (moved[2] - TRUE[Wheel.DRIFT] * way) / TRUE[Wheel.TURN]
        noise = g.normal(0.0, (4e-4, 1e-4, 2e-4))
        wheels = compose(wheels, np.array((way, 0.0, yaw)) + noise)
        said.append(wheels)
        seen.append(compose(base, TRUE[Wheel.MOUNT_X :]) + g.normal(0.0, (0.003, 0.003, 0.001)))
    poses = np.array(said)
    poses[:, 2] = np.unwrap(poses[:, 2])
    return poses, np.array(seen)


@pytest.mark.parametrize("seed", [1, 2])
def test_what_was_put_in_is_found(seed: int) -> None:
    fit = fit_wheels(*drive(seed), np.array((0.28, 0.0, 0.0)))
    assert all(fit.told)
    z = (fit.value - TRUE) / fit.sigma
    assert np.abs(z).max() < 4.5, z
    assert fit.sigma[Wheel.SCALE] < 0.003
    assert fit.sigma[Wheel.MOUNT_X] < 0.01
    assert fit.after[0] < fit.before[0]
    assert fit.after[1] < fit.before[1]


def test_straight_ahead_tells_neither_track_nor_arm() -> None:
    fit = fit_wheels(*drive(3, turns=False), np.array((0.28, 0.0, 0.0)))
    assert fit.told[Wheel.SCALE]
    assert fit.told[Wheel.MOUNT_YAW]
    assert not fit.told[Wheel.TURN]
    assert not fit.told[Wheel.MOUNT_X]
    assert fit.value[Wheel.MOUNT_X] == pytest.approx(0.28, abs=0.05)


def test_slipping_wheels_do_not_matter() -> None:
    wheels, laser = drive(4)
    for k in range(200, 3000, 400):  # the wheels spin on the spot
        wheels[k:] = [
            compose(wheels[k - 1], compose(np.array((0.3, 0.0, 0.0)), between(wheels[k - 1], p))) for p in wheels[k:]
        ]
    wheels[:, 2] = np.unwrap(wheels[:, 2])
    fit = fit_wheels(wheels, laser, np.array((0.28, 0.0, 0.0)))
    assert fit.value[:2] == pytest.approx(TRUE[:2], abs=0.01)


def test_too_little_motion_is_said() -> None:
    wheels, laser = drive(5, n=60)
    with pytest.raises(ValueError, match="drive farther"):
        fit_wheels(wheels, laser, np.zeros(3))
