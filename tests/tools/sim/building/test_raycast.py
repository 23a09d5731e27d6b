"""The cast scan against a slow twin and cases worked out by hand; tours keep clear of surfaces."""

import numpy as np
import pytest

from tools.sim.building.beams import IDEAL, Optics, Poses, Posture, Returns, Scanner, Sweep
from tools.sim.building.buildings import BUILDINGS, building
from tools.sim.building.world import CIRCLE, MATERIAL_ID, Array, Plan, SimWorld
from tools.sim.robot.drive import Body, Drive

NOBODY = np.zeros((0, 7))
ALL_ROUND = Sweep(np.radians(np.arange(-540, 541) * 0.25), 0.0, 0.01875)


def standing(x: float, y: float, yaw: float) -> Poses:
    return lambda t: np.tile([float(x), float(y), float(yaw)], (len(t), 1))


def look(world: SimWorld, pose: tuple[float, float, float], optics: Optics = IDEAL, **kw: object) -> Returns:
    scanner = Scanner(world, kw.pop("sweep", ALL_ROUND), optics, 3)  # type: ignore[arg-type]  # test shorthand
    return scanner.measure(0.0, standing(*pose), kw.pop("movers", NOBODY), kw.pop("posture", Posture(0.3)))  # type: ignore[arg-type]  # test shorthand


def brute(shapes: Array, origin: Array, bearing: float) -> float:
    """Nearest surface by trying them all."""
    d = np.array([np.cos(bearing), np.sin(bearing)])
    best = np.inf
    for kind, a, b, c, e, _ in shapes:
        if kind == CIRCLE:
            w = np.array([a, b]) - origin
            along = w @ d
            below = along**2 - (w @ w - c**2)
            if below >= 0 and along > 0 and w @ w > c**2:
                best = min(best, along - np.sqrt(below))
            continue
        edge = np.array([c - a, e - b])
        system = np.column_stack([d, -edge])
        if abs(np.linalg.det(system)) > 1e-12:
            t, u = np.linalg.solve(system, np.array([a, b]) - origin)
            if t > 0 and 0 <= u <= 1:
                best = min(best, t)
    return best


def box(width: float = 10.0, depth: float = 8.0) -> Plan:
    plan = Plan()
    plan.outline([(0, 0), (width, 0), (width, depth), (0, depth)])
    return plan


def test_box_room_in_closed_form() -> None:
    seen = look(box().build(), (3.0, 5.0, 0.0))
    a = ALL_ROUND.bearing_rad
    with np.errstate(divide="ignore"):
        x = np.where(np.cos(a) > 0, 7.0 / np.cos(a), -3.0 / np.cos(a))
        y = np.where(np.sin(a) > 0, 3.0 / np.sin(a), -5.0 / np.sin(a))
    np.testing.assert_allclose(seen.range_m[:, 0], np.minimum(np.abs(x), np.abs(y)), atol=1e-9)


@pytest.mark.parametrize("name", ["paper_room", "office_floor", "warehouse_hall", "corridor_loop"])
def test_cells_miss_nothing(name: str) -> None:
    """Against the slow twin from places along the tour; panes and mirrors made matt so that one echo is the answer."""
    place = building(name)
    shapes = place.world.shapes.copy()
    shapes[:, 5] = MATERIAL_ID["wall"]
    world = SimWorld(shapes, place.world.cell_start, place.world.cell_items, place.world.frame, place.world.polished)
    drive = Drive(place.route, Body())
    few = Sweep(np.radians(np.linspace(-180, 180, 23)[:-1] + 0.37), 0.0, 0.01)
    for pose in drive.pose(np.linspace(3.0, drive.lap_s, 6)):
        seen = look(world, tuple(pose), sweep=few)
        want = np.array([brute(shapes, pose[:2], pose[2] + b) for b in few.bearing_rad])
        want[want > IDEAL.limit_m] = 0.0
        np.testing.assert_allclose(seen.range_m[:, 0], np.where(np.isfinite(want), want, 0.0), atol=1e-8)


def test_each_beam_is_cast_from_where_the_lidar_is_then() -> None:
    world = box(20.0, 20.0).build()
    sweep = Sweep(np.radians(np.linspace(-90, 90, 721)), 0.00625, 0.0125)
    scanner = Scanner(world, sweep, IDEAL)

    def poses(t: Array) -> Array:
        return np.column_stack([5.0 + 2.0 * t, 10.0 + 0.0 * t, 0.5 * t])

    seen = scanner.measure(1.0, poses, NOBODY, Posture()).range_m[:, 0]
    t = 1.0 + sweep.first_s + np.linspace(0, sweep.sweep_s, 721)
    angle = sweep.bearing_rad + 0.5 * t
    on_wall = np.abs(angle) < 0.5
    np.testing.assert_allclose(seen[on_wall], ((20.0 - 5.0 - 2.0 * t) / np.cos(angle))[on_wall], atol=1e-6)


def one(bearing_deg: float) -> Sweep:
    return Sweep(np.radians([bearing_deg]), 0.0, 0.0)


@pytest.mark.parametrize("name", sorted(BUILDINGS))
def test_tour_keeps_clear_of_everything(name: str) -> None:
    place = building(name)
    drive = Drive(place.route, Body())
    track = drive.pose(np.arange(0.0, drive.lap_s, 0.1))[:, :2]
    assert place.world.clearance(track).min() > 0.35
