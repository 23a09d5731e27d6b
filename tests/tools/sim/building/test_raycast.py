"""The cast scan against plain geometry: a slow twin that tries every surface, and cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tools.sim.building.beams import IDEAL, UTM_30LX, Optics, Poses, Posture, Returns, Scanner, Sweep
from tools.sim.building.buildings import building
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


@pytest.mark.parametrize("yaw", [0.0, np.pi / 2, np.pi, -np.pi / 2])
def test_rays_along_the_axes(yaw: float) -> None:
    """A ray that runs exactly along a row of cells, where a division by zero waits."""
    ahead = Sweep(np.zeros(1), 0.0, 0.0)
    seen = look(box().build(), (4.0, 3.0, yaw), sweep=ahead)
    want = {0.0: 6.0, np.pi / 2: 5.0, np.pi: 4.0, -np.pi / 2: 3.0}[yaw]
    assert seen.range_m[0, 0] == pytest.approx(want, abs=1e-9)


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


def pane(distance: float = 3.0, behind: float = 6.0) -> SimWorld:
    """A pane across the way at x = distance, a wall behind it, and walls around."""
    plan = Plan()
    plan.line((distance, -30), (distance, 30), "glass")
    plan.line((behind, -30), (behind, 30))
    plan.line((-5, -30), (-5, 30))
    return plan.build()


def one(bearing_deg: float) -> Sweep:
    return Sweep(np.radians([bearing_deg]), 0.0, 0.0)


def test_pane_is_seen_only_squarely() -> None:
    clear = Optics(sigma_m=0.0, sigma_weak_m=0.0, dark_bias_m=0.0, leading_edge=0.0, dropout=0.0, speckle=0.0)
    square = look(pane(), (0, 0, 0), clear, sweep=one(0.2)).range_m[0]
    assert square[0] == pytest.approx(3.0, abs=0.01)
    assert square[1] == pytest.approx(6.0, abs=0.01)  # second echo: the wall behind
    oblique = look(pane(), (0, 0, 0), clear, sweep=one(30)).range_m[0]
    assert oblique[0] == pytest.approx(6.0 / np.cos(np.radians(30)), abs=0.01)


def test_pane_mirrors_at_grazing_incidence() -> None:
    """86 deg off the normal the pane shows the wall at x = -5 as if it stood mirrored behind the pane."""
    seen = look(pane(3.0, 60.0), (2.5, 0, 0), UTM_30LX, sweep=one(86)).range_m[0]
    assert not np.any(np.abs(seen - 0.5 / np.cos(np.radians(86))) < 0.1)
    plan = Plan()
    plan.line((3, -30), (3, 30), "glass")
    plan.line((-30, 12), (2.9, 12))
    ghost = look(plan.build(), (2.5, 0, 0), UTM_30LX, sweep=one(86)).range_m[0]
    assert np.any(np.abs(ghost - 12.0 / np.sin(np.radians(86))) < 0.15)


def test_light_through_a_pane_is_weaker() -> None:
    open_view = Plan()
    open_view.line((6, -30), (6, 30))
    open_view.line((-5, -30), (-5, 30))
    through = look(pane(), (0, 0, 0), IDEAL, sweep=one(20))
    direct = look(open_view.build(), (0, 0, 0), IDEAL, sweep=one(20))
    k = int(np.flatnonzero(np.abs(through.range_m[0] - direct.range_m[0, 0]) < 1e-4)[0])
    energy = (through.intensity[0, k] / direct.intensity[0, 0]) ** 2
    assert energy == pytest.approx(0.92**2, rel=0.02)  # 8 % lost each way


def test_matt_floor_ends_the_beam_and_polished_floor_passes_it_on() -> None:
    plan = box(30.0, 10.0)
    matt = plan.build()
    plan.polish(0, 0, 30, 10)
    polished = plan.build()
    dipping = Posture(0.3, pitch=0.02)  # meets the floor 15 m ahead
    sigma_free = Optics(sigma_m=0.0, sigma_weak_m=0.0, dark_bias_m=0.0, leading_edge=0.0, dropout=0.0, speckle=0.0)
    assert look(matt, (1, 5, 0), sigma_free, sweep=one(0), posture=dipping).range_m[0, 0] == 0.0
    assert look(polished, (1, 5, 0), sigma_free, sweep=one(0), posture=dipping).range_m[0, 0] == pytest.approx(29.0)
    assert look(matt, (1, 5, 0), sigma_free, sweep=one(80), posture=dipping).range_m[0, 0] > 4.9


def test_steep_dip_sees_the_matt_floor_itself() -> None:
    seen = look(box(30.0, 10.0).build(), (1, 5, 0), IDEAL, sweep=one(0), posture=Posture(0.3, pitch=0.1))
    assert seen.range_m[0, 0] == pytest.approx(3.0)


def test_moving_circle_is_met_where_it_is_then() -> None:
    """A post that crosses the view at 2 m/s: the last beam sees it displaced by speed times sweep time."""
    movers = np.array([[CIRCLE, 4.0, 0.0, 0.1, MATERIAL_ID["wall"], 2.0, 0.0]])
    sweep = Sweep(np.zeros(2), 0.0, 0.1)  # the same bearing at the begin and at the end of 0.1 s
    scanner = Scanner(box(20.0, 20.0).build(), sweep, IDEAL)
    seen = scanner.measure(0.0, standing(1.0, 0.0, 0.0), movers, Posture()).range_m[:, 0]
    assert seen[0] == pytest.approx(2.9)
    assert seen[1] == pytest.approx(3.1)
