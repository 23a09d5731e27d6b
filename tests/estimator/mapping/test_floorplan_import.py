"""Cells from elsewhere: walls as lines, free space as seen from all over the floor, and localising in them."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.floorplan_import import FREE, OCCUPIED, UNKNOWN, Cells, image_of_cells, plan_of
from estimator.mapping.keyframe import keep
from estimator.mapping.live_grid import at_once
from estimator.mapping.loop_verification import Candidate, LoopSettings, look_in
from estimator.mapping.map_snapshot import Identity, MapImage, finished
from estimator.mapping.occupancy_grid import Grid
from estimator.measurements import UNLIMITED, Answer, Array, Job, Odometry, Record
from estimator.numerics import se2
from estimator.pipeline import step
from estimator.scan_matching.local_map import contradicted
from estimator.stored_map import restored
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene, bearings, office, paper_room

pytestmark = pytest.mark.jit
WHO = Identity(5, "ground floor")
WIDE = bearings(361, 270.0)


def trinary(grid: Grid) -> Cells:
    cells = np.full(grid.log_odds.shape, UNKNOWN, np.int8)
    cells[grid.probability > 0.65] = OCCUPIED
    cells[grid.probability < 0.196] = FREE
    return cells


def mapped(scene: Scene, resolution: float, n: int) -> tuple[Cells, Array]:
    """What a robot that has been everywhere exports: cells, and where they lie."""
    rng = np.random.default_rng(3)
    pieces = []
    for key in range(1, n + 1):
        T = scene.place(rng)
        frame = keep(key, T, T, scan_in(scene, T, WIDE, rng), 0.0)
        pieces.append((frame.submap, [frame]))
    grid = at_once(pieces, resolution)
    return trinary(grid), np.array((*grid.origin, 0.0))


def drawn(scene: Scene, resolution: float) -> tuple[Cells, Array]:
    """What an architect exports: lines on white."""
    low = scene.walls.reshape(-1, 2).min(axis=0) - (0.513, 0.521)
    columns, rows = np.ceil((scene.walls.reshape(-1, 2).max(axis=0) + 0.5 - low) / resolution).astype(int)
    cells = np.full((rows, columns), FREE, np.int8)
    lines = [np.column_stack((np.linspace(a, c, 2000), np.linspace(b, d, 2000))) for a, b, c, d in scene.walls.tolist()]
    turn = np.linspace(0, 2 * np.pi, 400)
    lines += [np.column_stack((x + r * np.cos(turn), y + r * np.sin(turn))) for x, y, r in scene.columns.tolist()]
    at = np.floor((np.vstack(lines) - low) / resolution).astype(int)
    cells[at[:, 1], at[:, 0]] = OCCUPIED
    return cells, np.array((*low, 0.0))


def localised(image: MapImage, scene: Scene, T_map_scene: Array, n: int) -> tuple[Array, int]:
    """Errors (k, 2), m and rad, of scans from random places, searched from 0.15 m and 2 deg off; how many were lost."""
    rng, errors, lost = np.random.default_rng(8), [], 0
    for _ in range(n):
        T = scene.place(rng)
        frame = keep(1, T, T, scan_in(scene, T, WIDE, rng), 0.0)
        true = se2.compose(T_map_scene, T)
        guess = se2.compose(true, np.array((*rng.normal(0.0, 0.1, 2), rng.normal(0.0, 0.03))))
        near = sorted(image.submaps, key=lambda one: np.hypot(*(one.T_map_submap - true)[:2]))[:3]
        found = []
        for one in near:
            assert one.settled is not None
            there = se2.between(one.T_map_submap, guess)
            hit = look_in(frame, Candidate(one.key, one.settled, there, np.diag((0.04, 0.04, 0.01))), LoopSettings())
            if hit is not None:
                found.append((hit.share, se2.between(true, se2.compose(one.T_map_submap, hit.T_submap_keyframe))))
        if found:
            off = max(found, key=lambda one: one[0])[1]
            errors.append((np.hypot(*off[:2]), abs(off[2])))
        lost += not found
    return np.array(errors), lost


@pytest.mark.parametrize(("resolution", "most_m"), [(0.05, 0.03), (0.1, 0.06)])
def test_in_an_architects_drawing_a_place_is_told_to_a_fraction_of_a_cell(resolution: float, most_m: float) -> None:
    scene, T = office(), np.array((3.0, -2.0, 0.4))  # an origin that is turned
    cells, at = drawn(scene, resolution)
    image = image_of_cells(cells, resolution, se2.compose(T, at), WHO)
    errors, lost = localised(image, scene, T, 60)
    assert lost <= 12
    assert np.percentile(errors[:, 0], 95) < most_m
    assert np.percentile(np.degrees(errors[:, 1]), 95) < 1.0


def test_in_the_map_that_we_export_ourselves_too() -> None:
    cells, at = mapped(paper_room(), 0.05, 60)
    errors, lost = localised(image_of_cells(cells, 0.05, at, WHO), paper_room(), np.zeros(3), 60)
    assert lost <= 3
    assert np.percentile(errors[:, 0], 95) < 0.03
    assert np.percentile(np.degrees(errors[:, 1]), 95) < 0.4


def test_lines_lie_on_the_walls_and_look_into_the_room() -> None:
    scene = paper_room()
    cells, at = mapped(scene, 0.05, 60)
    plan = plan_of(cells, 0.05)
    xy = plan.lines[:, :2] + at[:2]
    to_wall = np.abs(5.0 - np.abs(xy).max(axis=1))
    to_column = np.abs(np.hypot(*(np.abs(xy) - 2.5).T) - 0.25)
    assert np.percentile(np.minimum(to_wall, to_column), 95) < 0.045  # the columns are five cells wide
    wall = (to_wall < 0.04) & (np.abs(xy).min(axis=1) < 4.5)
    which = np.abs(xy).argmax(axis=1)
    rows = np.arange(len(xy))
    inward = -np.sign(xy[rows, which]) * plan.lines[rows, 2 + which]
    assert (inward[wall] > 0.95).mean() > 0.99
    np.testing.assert_allclose(np.hypot(*plan.lines[:, 2:4].T), 1.0)


def test_a_place_that_is_not_the_robots_is_contradicted() -> None:
    """The witness knows what is free: a scan from elsewhere has evidence against it, the right one next to none."""
    scene, rng = office(), np.random.default_rng(2)
    cells, at = drawn(scene, 0.05)
    image = image_of_cells(cells, 0.05, at, WHO)
    right, wrong = [], []
    for _ in range(40):
        T = scene.place(rng)
        frame = keep(1, T, T, scan_in(scene, T, WIDE, rng), 0.0)
        one = min(image.submaps, key=lambda one: np.hypot(*(one.T_map_submap - T)[:2]))
        assert one.settled is not None
        true = se2.between(one.T_map_submap, T)
        for to, off in ((right, np.zeros(3)), (wrong, np.array((1.0, 0.7, 0.8)))):
            to.append(contradicted(one.settled.local(), se2.compose(true, off), frame.beams(), one.settled.sigma))
    assert np.median(right) < 0.03
    assert np.median(wrong) > 0.2


def test_the_image_is_one_map_that_a_robot_can_start_in_and_that_draws_itself() -> None:
    cells, at = mapped(office(), 0.05, 150)
    image = image_of_cells(cells, 0.05, at, WHO)
    assert finished(image).submaps == image.submaps
    assert image.identity == WHO
    keys = [piece.key for piece in image.submaps]
    assert set(image.constraints.between.ravel().tolist()) == set(keys)
    for (a, b), T in zip(image.constraints.between.tolist(), image.constraints.T, strict=True):
        places = {piece.key: piece.T_map_submap for piece in image.submaps}
        np.testing.assert_allclose(se2.between(places[a], places[b]), T, atol=1e-12)
    state = restored(image)
    assert state.map.parts.detached == 1 + max(keys)
    assert len(state.map.keyframes) == len(image.frames)
    grid = at_once([(frame.submap, [frame]) for frame in state.map.keyframes.values()], 0.05)
    again = trinary(grid)
    low = np.rint((grid.origin - at[:2]) / 0.05).astype(int)
    i, j = np.maximum(low, 0)
    k, m = np.maximum(-low, 0)
    rows, columns = min(cells.shape[0] - j, again.shape[0] - m), min(cells.shape[1] - i, again.shape[1] - k)
    a, b = cells[j : j + rows, i : i + columns], again[m : m + rows, k : k + columns]
    free = (a == FREE) & (b != UNKNOWN)
    assert (b[free] == FREE).mean() > 0.97
    assert free.sum() > 0.9 * (a == FREE).sum()


def test_without_walls_or_room_there_is_nothing_to_be_localised_in() -> None:
    with pytest.raises(ValueError, match="the map has no free position beside a wall, so"):
        image_of_cells(np.zeros((40, 40), np.int8), 0.05, np.zeros(3), WHO)
    with pytest.raises(ValueError, match="the map has no free position beside a wall, so"):
        image_of_cells(np.ones((40, 40), np.int8), 0.05, np.zeros(3), WHO)


def test_a_robot_that_starts_in_an_imported_map_finds_itself_and_stays_right() -> None:
    """Along the office's corridor, wheels 1 % off: found within a few metres, then never more than a cell off."""
    scene, T_map_scene, rng = office(), np.array((3.0, -2.0, 0.4)), np.random.default_rng(1)
    cells, at = drawn(scene, 0.05)
    state = restored(image_of_cells(cells, 0.05, se2.compose(T_map_scene, at), WHO))
    jobs: tuple[Job, ...] = ()
    errors: list[Array] = []
    last = np.zeros(3)
    for k in range(60):
        x, t = 1.5 + 0.08 * k, 0.1 * k
        T = np.array((x, 6.0 + 0.15 * np.sin(x), 0.1 * np.sin(3.0 * x)))
        records: list[Record] = [Answer(t, job.job_id, job.run()) for job in jobs]
        if k:
            records.append(Odometry(t - 0.1, t, se2.between(last, T) * (1.01, 1.01, 1.0)))
        result = step(state, [*records, replace(scan_in(scene, T, WIDE, rng, t=t), seq=k)], UNLIMITED)
        jobs, last = result.jobs, T
        if result.places is None:
            pose = se2.compose(result.T_map_odom, result.T_odom_base)
            errors.append(se2.between(se2.compose(T_map_scene, T), pose))
    assert len(errors) > 20
    off = np.array(errors)
    assert np.hypot(*off[:, :2].T).max() < 0.05
    assert np.degrees(np.abs(off[:, 2])).max() < 0.5
