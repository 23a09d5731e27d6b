"""Errors of the simulated lidar: noise, incidence and edges; repeatability."""

from dataclasses import replace

import numpy as np

from tests.tools.sim.building.test_raycast import NOBODY, one, standing
from tools.sim.building.beams import UTM_30LX, Optics, Posture, Scanner, Sweep
from tools.sim.building.world import Array, Plan


def wall_at(distance: float, material: str = "wall") -> Plan:
    plan = Plan()
    plan.line((distance, -40), (distance, 40), material)
    plan.line((-3, -40), (-3, 40))
    return plan


def ranges(plan: Plan, bearing_deg: float, optics: Optics = UTM_30LX, scans: int = 400) -> Array:
    """First echoes of one beam over many scans; 0 where nothing came back."""
    scanner = Scanner(plan.build(), one(bearing_deg), optics, 5)
    pose = standing(0, 0, 0)
    return np.array([scanner.measure(k * 0.025, pose, NOBODY, Posture()).range_m[0, 0] for k in range(scans)])


def error(plan: Plan, bearing_deg: float, true: float, optics: Optics = UTM_30LX) -> tuple[float, float]:
    """Mean error and standard deviation of what came back."""
    got = ranges(plan, bearing_deg, replace(optics, speckle=0.0))
    got = got[got > 0]
    assert len(got) > 200
    return float(got.mean() - true), float(got.std())


def test_noise_grows_with_distance() -> None:
    """About 1 cm near by and 3 cm at 30 m, as the makers state for this class."""
    near, far = error(wall_at(3.0), 0.0, 3.0)[1], error(wall_at(29.0), 0.0, 29.0)[1]
    assert 0.005 < near < 0.012
    assert 0.015 < far < 0.035


def test_oblique_walls_are_noisier_and_read_short() -> None:
    """80 deg of incidence at 4 m: the beam's footprint is 9 cm deep and its near edge triggers."""
    true = 1.0 / np.cos(np.radians(80))
    square, oblique = error(wall_at(true), 0.0, true), error(wall_at(1.0), 80.0, true)
    assert oblique[1] > 1.25 * square[1]
    assert oblique[0] < square[0] - 0.004


def test_mixed_pixels_only_where_the_echoes_overlap() -> None:
    """A post's edge in the middle of the beam: a step of 0.2 m melts, one of 2 m gives the nearer surface."""
    quiet = Optics(sigma_m=0.0, sigma_weak_m=0.0, dark_bias_m=0.0, leading_edge=0.0, dropout=0.0, speckle=0.0)
    for step, low, high in ((0.2, 3.02, 3.18), (2.0, 2.99, 3.01)):
        plan = wall_at(3.0 + step)
        plan.line((3.0, 0.001), (3.0, 1.0))
        got = ranges(plan, 0.0, quiet, scans=3)
        assert np.all((got > low) & (got < high)), (step, got)


def test_a_scan_is_a_function_of_time_and_seed() -> None:
    sweep = Sweep(np.linspace(-1.5, 1.5, 721), 0.0, 0.0125)
    plan = wall_at(5.0).build()

    def scan(seed: int, t: float, before: tuple[float, ...] = ()) -> Array:
        scanner = Scanner(plan, sweep, UTM_30LX, seed)
        for earlier in before:
            scanner.measure(earlier, standing(0, 0, 0), NOBODY, Posture())
        return scanner.measure(t, standing(0, 0, 0), NOBODY, Posture()).range_m

    np.testing.assert_array_equal(scan(1, 2.5), scan(1, 2.5, before=(0.0, 9.9)))
    assert np.any(scan(1, 2.5) != scan(2, 2.5))
    assert np.any(scan(1, 2.5) != scan(1, 2.525))
