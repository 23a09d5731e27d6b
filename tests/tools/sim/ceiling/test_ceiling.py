"""The ceiling against physics that can be worked out by hand, and effect by effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tools.sim.building.building import Building
from tools.sim.building.buildings import BUILDINGS, building
from tools.sim.building.world import Plan
from tools.sim.ceiling import optics
from tools.sim.ceiling.ceiling import IDEAL, Ceiling, Effects, ceiling_of, paper_ceiling
from tools.sim.ceiling.lamps import Fixture, fixtures
from tools.sim.ceiling.movers import rows_of
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


@pytest.mark.parametrize("odd", [0.0, 1.0])
def test_a_lamp_radiates_what_it_is_said_to_and_half_of_it_at_its_half_angle(odd: float) -> None:
    table = optics.emission(70.0, odd, np.zeros(4))
    gamma = np.linspace(0, np.pi / 2, 2000)
    ring = np.interp(gamma, optics.ANGLES, table.mean(axis=1)) * np.sin(gamma) * 2 * np.pi
    assert np.trapezoid(ring, gamma) == pytest.approx(1.0, abs=2e-3)
    assert np.interp(np.radians(70.0), optics.ANGLES, table.mean(axis=1)) / table[0, 0] == pytest.approx(0.5, abs=0.01)


def test_the_tables_are_not_powers_of_a_cosine() -> None:
    table = optics.emission(70.0, 1.0, np.zeros(4))[:24]  # up to 57.5 degrees
    cosine = np.log(np.cos(optics.ANGLES[:24]))
    left = np.log(table.mean(axis=1)) - np.log(table[0, 0])
    order = float(left @ cosine / (cosine @ cosine))
    assert np.abs(left - order * cosine).max() > 0.01
    assert np.ptp(np.log(table[23])) > 0.05


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


def test_shelves_are_solid_between_their_heights_only() -> None:
    plan = empty()
    plan.shelf((0.9, 1.1), (-1.0, 1.0), (1.5, 2.0))
    ceiling, free = hall(plan, obstacles=True), hall(plan)
    assert at(ceiling, 2.0 + 0.1, 0.0) == 0.0  # passes x = 1 at 1.6 m
    assert at(ceiling, 1.3 + 0.1, 0.0) == at(free, 1.4, 0.0)  # below it
    assert at(ceiling, 3.9, 0.0) == at(free, 3.9, 0.0)  # above it


def test_people_cast_soft_shadows_from_the_head_down() -> None:
    ceiling = hall(empty(), people=True)
    ceiling.movers = lambda t, poses: rows_of(np.tile([1.0, 0.0], (len(t), 1, 1)))
    free = hall(empty())
    x = np.linspace(0.4, 4.3, 400)
    poses = np.column_stack([x + 0.1, np.zeros(400), np.zeros(400)])
    share = ceiling.amplitudes(poses, np.zeros(400))[:, 0] / free.amplitudes(poses, np.zeros(400))[:, 0]
    assert share[x < 0.75] == pytest.approx(1.0)
    assert share[(x > 1.3) & (x < 2.5)] == pytest.approx(0.0, abs=0.2)
    assert share[x > 3.0] == pytest.approx(1.0, abs=0.01)
    y = np.linspace(-0.6, 0.6, 200)
    across = np.column_stack([np.full(200, 2.1), y - 0.03, np.zeros(200)])
    share = ceiling.amplitudes(across, np.zeros(200))[:, 0] / free.amplitudes(across, np.zeros(200))[:, 0]
    assert np.any((share > 0.2) & (share < 0.8))
    assert share[0] == share[-1] == 1.0


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


def test_a_second_bounce_adds_some_and_dark_walls_add_nothing() -> None:
    one, two, dark = (paper_ceiling(replace(IDEAL, rho=r, bounces=b)) for r, b in ((0.7, 1), (0.7, 2), (0.0, 1)))
    poses = places(50, reach=4.7)
    a, b, none = (c.by_the_walls(poses[:, :2]).sum() for c in (one, two, dark))
    assert none == 0.0
    assert 1.02 * a < b < 1.7 * a


def test_walls_give_a_few_per_cent_and_most_near_them() -> None:
    """Published figures for white walls: some 4 to 9 % of the direct light, 18 % at the ninth decile."""
    ceiling = paper_ceiling(replace(IDEAL, rho=0.7, bounces=1))
    poses = places(400, reach=4.8)
    walls, plain = ceiling.by_the_walls(poses[:, :2]), paper_ceiling(IDEAL).amplitudes(poses, np.zeros(400))
    whole = ceiling.amplitudes(poses, np.zeros(400))
    share = whole[plain > 0] / plain[plain > 0] - 1.0
    assert 0.01 < np.median(share) < 0.09
    assert 0.05 < np.percentile(share, 90) < 0.40
    edge = np.abs(poses[:, :2]).max(axis=1)
    assert walls[edge > 4.3].sum(axis=1).mean() > 2.0 * walls[edge < 2.5].sum(axis=1).mean()


def test_the_diffuse_floor_swings_by_half_and_stays_in_its_room() -> None:
    ceiling = paper_ceiling(replace(IDEAL, floor=0.015, floor_swing=0.5))
    even = paper_ceiling(replace(IDEAL, floor=0.015))
    poses = places(2000, reach=4.9)
    ratio = ceiling.diffuse(poses[:, :2]) / even.diffuse(poses[:, :2])
    assert 0.5 - 1e-9 <= ratio.min() < 0.7
    assert 1.3 < ratio.max() <= 1.5 + 1e-9
    assert even.diffuse(np.array([[-8.0, 0.0]])).max() < 0.2 * even.diffuse(np.array([[-4.5, 0.0]])).max()


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


def test_a_lean_of_the_receiver_turns_with_the_robot() -> None:
    """1.7 % per degree at 45 degrees."""
    ceiling = hall(empty())
    ceiling.receiver_lean = np.radians([1.0, 0.0])
    straight = hall(empty())
    toward = at(ceiling, -2.6 + 0.1, 0.0, 0.0) / at(straight, -2.6 + 0.1, 0.0, 0.0)
    away = at(ceiling, -2.6 - 0.1, 0.0, np.pi) / at(straight, -2.6 - 0.1, 0.0, np.pi)
    assert toward - 1 == pytest.approx(0.0175, abs=0.001)
    assert away - 1 == pytest.approx(-0.0175, abs=0.001)


def test_a_moved_lamp_shines_from_elsewhere_and_the_plan_stays() -> None:
    ceiling = paper_ceiling(IDEAL)
    other = ceiling.moved(6, (0.5, 0.0))
    assert other.fixtures == ceiling.fixtures
    poses = np.array([[ceiling.fixtures[5].x + 0.1, ceiling.fixtures[5].y, 0.0]])
    assert other.amplitudes(poses, np.zeros(1))[0, 5] < ceiling.amplitudes(poses, np.zeros(1))[0, 5]
    assert ceiling.placed[5, 0] == ceiling.fixtures[5].x


def test_gains_are_spread_as_asked_and_one_effect_does_not_stir_another() -> None:
    a, b = (ceiling_of(building("office_floor"), Effects(gain_spread=g), seed=4) for g in (0.05, 0.15))
    spread = np.log(a.power_w / [f.power_w for f in a.fixtures]).std()
    assert spread == pytest.approx(0.05, rel=0.2)
    np.testing.assert_allclose(np.log(b.power_w / 1.5), 3.0 * np.log(a.power_w / 1.5))
    np.testing.assert_array_equal(a.placed, b.placed)
    np.testing.assert_array_equal(a.emission, b.emission)


@pytest.mark.parametrize("name", sorted(BUILDINGS))
def test_every_building_is_lit_along_its_tour(name: str) -> None:
    place = building(name)
    lamps = fixtures(place)
    route = np.array(place.route.corners)
    at_xy = np.array([(f.x, f.y) for f in lamps])
    assert len({f.lamp_id for f in lamps}) == len(lamps)
    assert all(0 <= f.code <= 128 for f in lamps)
    nearest = np.hypot(*(route[:, None] - at_xy).transpose(2, 0, 1)).min(axis=1)
    assert nearest.max() < 0.9 * place.height_m
    ceiling = ceiling_of(place, Effects(rho=0.0))
    poses = np.column_stack([route, np.zeros(len(route))])
    received = ceiling.amplitudes(poses, np.zeros(len(route)))
    assert np.all(np.sum(received > 0.05 * received.max(), axis=1) >= 2)


def test_an_office_has_more_lamps_than_codes_and_reuses_them_far_apart() -> None:
    lamps = fixtures(building("office_floor"))
    assert len(lamps) > 129
    by_code: dict[int, list[Fixture]] = {}
    for lamp in lamps:
        by_code.setdefault(lamp.code, []).append(lamp)
    apart = [np.hypot(a.x - b.x, a.y - b.y) for same in by_code.values() for a in same for b in same if a is not b]
    assert len(apart) > 0
    assert min(apart) > 15.0


def test_a_corridor_has_a_lamp_every_three_metres() -> None:
    lamps = [f for f in fixtures(building("corridor_loop")) if f.y < 2.2]
    assert np.diff(sorted(f.x for f in lamps)).max() <= 3.0
    with pytest.raises(ValueError, match="nobody has planned lamps for 'shed'"):
        fixtures(Building("shed", empty().build(), Route(((0.0, 0.0), (1.0, 0.0)))))
