"""The ceiling against closed forms: Lambertian sources, shadows, one bounce, and the state of lamps."""

from dataclasses import replace

import numpy as np
import pytest

from tools.sim.building.buildings import Building
from tools.sim.building.world import Plan
from tools.sim.ceiling import optics
from tools.sim.ceiling.ceiling import IDEAL, Ceiling, paper_ceiling
from tools.sim.ceiling.lamps import Fixture
from tools.sim.robot.drive import Route

ROOM = (-5.0, -5.0, 5.0, 5.0)


def hall(plan: Plan, lamp: tuple[float, float, float] = (0.0, 0.0, 2.9), **effects: float) -> Ceiling:
    """One lamp over what is drawn."""
    place = Building("test", plan.build(), Route(((0.0, 0.0), (1.0, 0.0), (1.0, 1.0))))
    return Ceiling((Fixture(*lamp, ROOM, 1, 5),), place.world, 3.0, replace(IDEAL, **effects))


def empty() -> Plan:
    plan = Plan()
    plan.outline([(-5, -5), (5, -5), (5, 5), (-5, 5)], "black")
    return plan


def at(ceiling: Ceiling, x: float, y: float, yaw: float = 0.0, t: float = 0.0) -> float:
    return float(ceiling.amplitudes(np.array([[x, y, yaw]]), np.array([t]))[0, 0])


def places(n: int = 200, seed: int = 0, reach: float = 4.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-reach, reach, (n, 2)), rng.uniform(-np.pi, np.pi, n)])


def test_ideal_lamps_follow_lambert_and_the_inverse_square() -> None:
    """Eq. (1) with Table 1: 1.5 W, 70 degrees, 1.2 cm^2, at 2.6 m."""
    ceiling = paper_ceiling(IDEAL)
    poses = places()
    got = ceiling.amplitudes(poses, np.zeros(len(poses)))
    pd, m = ceiling.photodiode, optics.lambert_order(70.0)
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    eye = poses[:, :2] + np.column_stack([c * pd.x - s * pd.y, s * pd.x + c * pd.y])
    for k, lamp in enumerate(ceiling.fixtures):
        square = (eye[:, 0] - lamp.x) ** 2 + (eye[:, 1] - lamp.y) ** 2 + 2.6**2
        cosine = 2.6 / np.sqrt(square)
        seen = cosine > np.cos(np.radians(59.4))
        want = 0.3 * 0.4 * 1.5 * (m + 1) / (2 * np.pi) * 1.2e-4 * cosine ** (m + 1) / square
        np.testing.assert_allclose(got[seen, k], want[seen], rtol=5e-3)
        assert np.all(got[cosine < np.cos(np.radians(60.6)), k] == 0.0)
    assert got.max() < 0.3 * 2.80e-6


def test_a_wall_a_column_a_pane_and_a_low_box_stand_in_the_way() -> None:
    plan = empty()
    plan.line((1.0, -1.0), (1.0, 1.0))
    plan.circle((0.0, 1.5), 0.2)
    plan.line((-1.0, -1.0), (-1.0, 1.0), "glass")
    plan.box((0.0, -1.5), (0.5, 0.1), 0.0, "wood", top=0.7)
    ceiling, free = hall(plan, obstacles=True), hall(plan)
    assert at(ceiling, 2.0, 0.0) == 0.0
    assert at(ceiling, 0.1, 3.0) == 0.0
    assert at(ceiling, -2.0, 0.0) == pytest.approx(0.85 * at(free, -2.0, 0.0))
    assert at(ceiling, 0.1, -2.5) == at(free, 0.1, -2.5) > 0.0
    assert at(ceiling, 0.1, -1.63) == 0.0


def test_one_bounce_agrees_with_a_sum_over_the_wall() -> None:
    """A white wall beside a dark room: the textbook double integral, patch by patch, in floating point."""
    plan = Plan()
    plan.line((1.0, -5.0), (1.0, 5.0))
    plan.line((-5.0, -5.0), (-5.0, 5.0), "black")
    ceiling = hall(plan, rho=0.6, bounces=1)
    got = float(ceiling.by_the_walls(np.array([[0.3, 0.7]]))[0, 0])
    y, z = np.meshgrid(np.arange(-4.975, 5, 0.05), np.arange(0.025, 3.0, 0.05))
    m = optics.lambert_order(70.0)
    d1 = np.sqrt(1 + y**2 + (2.9 - z) ** 2)
    shed = (m + 1) / (2 * np.pi) * np.clip((2.9 - z) / d1, 0, None) ** m * (1.0 / d1) / d1**2
    dx, dy, dz = 0.7, y - 0.7, z - 0.3
    d2 = np.sqrt(dx**2 + dy**2 + dz**2)
    cosine = np.where(dz / d2 > 0.5, dz / d2, 0.0)
    want = np.sum(shed * 0.6 / np.pi * (dx / d2) * cosine / d2**2) * 0.05**2
    assert got == pytest.approx(want, rel=0.08)
    assert float(ceiling.by_the_walls(np.array([[-4.0, 0.7]]))[0, 0]) < 0.2 * got
    twice = hall(plan, rho=0.6, bounces=2)
    assert float(twice.by_the_walls(np.array([[0.3, 0.7]]))[0, 0]) >= got


def test_lamps_age_warm_up_drift_and_go_out() -> None:
    t = np.array([0.0, 160.0, 320.0, 3000.0])
    ageing = paper_ceiling(replace(IDEAL, ageing=0.10), seed=2).powers(t) / 1.5
    assert np.all(np.abs(ageing[2] - 1) <= 0.10 + 1e-12)
    assert np.all(np.abs(ageing[2] - 1) >= 0.05)
    assert np.any(ageing[2] > 1)
    assert np.any(ageing[2] < 1)
    np.testing.assert_allclose(ageing[1] - 1, 0.5 * (ageing[2] - 1))
    np.testing.assert_array_equal(ageing[3], ageing[2])
    warm = paper_ceiling(replace(IDEAL, warm_up=0.05)).powers(t) / 1.5
    assert np.all(np.diff(warm, axis=0) < 0)
    assert np.all(warm[-1] < 1.001)
    ceiling = paper_ceiling(IDEAL)
    ceiling.switch_off(3, 100.0, 200.0)
    np.testing.assert_array_equal(ceiling.powers(t)[:, 2], [1.5, 0.0, 1.5, 1.5])
    with pytest.raises(ValueError, match="no lamp has the number 99; there are 1 to 16"):
        ceiling.switch_off(99)
