"""The map as tiles: only what is new or has moved is drawn again, what was moved in the room is forgotten."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.mapping.grid_patches import SIDE, UNIT, render
from estimator.mapping.keyframe import Keyframe, Submap, keep
from estimator.mapping.live_grid import LiveGrid, advance, at_once
from estimator.mapping.occupancy_grid import Grid
from estimator.measurements import UNLIMITED, Answer, Array, Beam, Job, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, new_state, render_map, step
from estimator.relocalisation.map_reset import forget_map
from estimator.state import State
from tests.estimator.circuit import circuit, drifted, lay, run_jobs
from tests.estimator.world import scan_in
from tools.bench.support.scenes import Scene, bearings, box

CELL = 0.05
HALF = bearings(181, 180.0)


def stretch(key: int, T_map: Array, scene: Scene, at: tuple[Array, ...]) -> tuple[Submap, list[Keyframe]]:
    """A submap at ``T_map``, seen in ``scene`` from poses ``at`` (map frame); its odometry lies elsewhere."""
    T_odom = np.array((100.0 * key, 5.0, 0.3))
    submap = Submap(key, 10 * key, T_map, T_odom)
    frames = []
    for number, T in enumerate(at):
        scan = scan_in(scene, T, HALF, None)
        frame = keep(10 * key + number, T, se2.compose(T_odom, se2.between(T_map, T)), scan, 0.0)
        frame.submap = submap
        frames.append(frame)
    return submap, frames


def settle(live: LiveGrid) -> None:
    while live.busy():
        live.take(advance(live.task()))


def far(x: float) -> Scene:
    """A room of 6 x 5 m, its middle at ``x``."""
    return Scene(np.array(box(x - 3.0, -2.5, x + 3.0, 2.5)), (x - 2.0, -2.0), (x + 2.0, 2.0))


def poses(x: float) -> tuple[Array, ...]:
    return tuple(np.array((x + dx, 0.3 * dx, yaw)) for dx in (-0.5, 0.0, 0.5) for yaw in (0.0, 1.6, 3.1, -1.6))


def two_rooms() -> tuple[LiveGrid, Submap, Submap]:
    """Rooms 40 m apart, each seen by a submap of its own."""
    live = LiveGrid(CELL)
    (a, seen_a), (b, seen_b) = (stretch(k, poses(x)[0], far(x), poses(x)) for k, x in ((1, 0.0), (2, 40.0)))
    live.laid(a, seen_a)
    live.laid(b, seen_b)
    settle(live)
    return live, a, b


def walls(grid: Grid) -> Array:
    """(n, 2) middles of occupied cells."""
    rows, columns = np.nonzero(grid.probability > 0.65)
    return grid.origin + (np.column_stack((columns, rows)) + 0.5) * grid.resolution


@pytest.mark.jit
def test_tiles_are_the_cells_that_casting_every_beam_into_the_map_gives() -> None:
    submap, frames = stretch(1, np.array((0.2, 0.1, 0.7)), far(0.0), poses(0.0))
    grid = at_once([(submap, frames)], CELL)
    xy = walls(grid)
    to_wall = np.minimum(np.abs(np.abs(xy[:, 0]) - 3.0), np.abs(np.abs(xy[:, 1]) - 2.5))
    assert to_wall.max() < 1.5 * CELL
    assert len(xy) > 0.8 * 22.0 / CELL
    free = (grid.probability < 0.196).sum() * CELL * CELL
    assert 0.9 * 30.0 < free < 1.02 * 30.0


@pytest.mark.jit
def test_a_submap_that_is_moved_takes_its_cells_along_and_only_its_tiles_are_composed_again() -> None:
    live, _, b = two_rooms()
    version, rendered, composed = live.version, live.rendered, live.composed
    before = dict(live.tiles)
    moved = np.array((0.4, -0.25, 0.05))
    b.T_map_submap = se2.compose(moved, b.T_map_submap)
    live.due = True
    settle(live)
    assert live.rendered == rendered  # a patch is rendered once
    near_b = {tile for tile in live.tiles if (tile[0] + 1) * SIDE * CELL > 30.0}
    new, changed = live.changed(version)
    assert new > version
    assert changed.keys() <= near_b
    assert 0 < live.composed - composed <= len(near_b) + 4
    assert all(live.tiles[tile] is before[tile] for tile in live.tiles.keys() - near_b)
    xy = walls(live.grid())
    back = se2.apply(se2.inverse(moved), xy[xy[:, 0] > 30.0]) - (40.0, 0.0)
    to_wall = np.minimum(np.abs(np.abs(back[:, 0]) - 3.0), np.abs(np.abs(back[:, 1]) - 2.5))
    assert to_wall.max() < 2.0 * CELL
    assert len(back) > 300


@pytest.mark.jit
def test_what_moves_by_less_than_shows_is_left_alone() -> None:
    live, a, b = two_rooms()
    composed = live.composed
    for submap in (a, b):
        submap.T_map_submap = submap.T_map_submap + np.array((0.004, -0.004, 0.0002))
    live.due = True
    settle(live)
    assert live.composed == composed
    assert live.changed(live.version) == (live.version, {})
    assert live.changed(0)[1].keys() == live.tiles.keys()


@pytest.mark.jit
def test_a_submap_out_of_the_graph_stays_in_the_map_while_it_says_something_of_its_own() -> None:
    live, a, b = two_rooms()
    b.hang_on(a, se2.between(a.T_map_submap, b.T_map_submap))
    again, seen = stretch(3, poses(40.0)[0], far(40.0), poses(40.0) * 4)
    live.due = True
    settle(live)
    assert set(live.drawn) == {1, 2}  # nobody else has seen that room
    for key in (3, 4):
        live.laid(replace(again, key=key), seen)
    settle(live)
    assert set(live.drawn) == {1, 3, 4}  # two newer ones have said everything that it said


@pytest.mark.jit
def test_of_the_newest_words_as_many_count_as_settle_a_cell() -> None:
    """A pallet that two later submaps have looked through is gone, one of them leaves it in doubt at most."""
    with_pallet = Scene(np.vstack((far(0.0).walls, box(1.0, 1.0, 1.8, 1.6))), (-2, -2), (2, 2))
    old = [stretch(key, np.zeros(3), with_pallet, poses(0.0)) for key in (1, 2)]
    new = [stretch(key, np.zeros(3), far(0.0), poses(0.0)) for key in (3, 4)]

    def pallet(pieces: list[tuple[Submap, list[Keyframe]]]) -> int:
        xy = walls(at_once(pieces, CELL))
        return int(((np.abs(xy - (1.4, 1.3)) < (0.5, 0.4)).all(axis=1)).sum())

    assert pallet(old) > 10
    assert pallet(old + new[:1]) <= 1
    assert pallet(old + new) == 0
    assert pallet(new + old) > 10  # and the other way round


@pytest.mark.jit
def test_forgetting_tells_those_who_look_that_the_tiles_are_empty() -> None:
    live, *_ = two_rooms()
    version, shown = live.changed(0)
    live.clear()
    now, empty = live.changed(version)
    assert now > version
    assert empty.keys() == shown.keys()
    assert not any(cells.any() for cells in empty.values())
    assert live.grid().log_odds.size == 0


@pytest.mark.jit
def test_a_patch_fits_in_its_words() -> None:
    submap, frames = stretch(1, np.zeros(3), far(0.0), poses(0.0) * 5)
    patch = render([(se2.between(submap.T_odom_submap, f.T_odom_lidar), f) for f in frames], np.zeros(3), CELL)
    cells = patch.cells()
    assert abs(cells).max() * UNIT == pytest.approx(5.0)
    assert patch.weight == np.abs(cells.astype(int)).sum()
    assert len(patch.packed) < 0.15 * cells.size


def test_a_resolution_that_is_none_is_refused() -> None:
    with pytest.raises(ValueError, match="must be positive"):
        at_once([], 0.0)


@pytest.mark.jit
def test_an_empty_map_is_an_empty_grid() -> None:
    assert at_once([], CELL).log_odds.shape == (0, 0)


@pytest.mark.jit
def test_live_and_final_are_the_same_map_and_a_loop_redraws_without_rendering() -> None:
    """A circuit with drift; the loop moves submaps, the tiles follow, and no patch is rendered twice for it."""
    state, truth = new_state(Settings(live_m=CELL)), circuit(laps=1.3)
    rng = np.random.default_rng(2)
    state.motion.T_odom_base = state.map.T_map_start = truth[0]
    for key, (T_odom, T_true) in enumerate(zip(drifted(truth, 1.004, 0.0008), truth, strict=True), 1):
        lay(state, T_odom, T_true, rng, key)
        run_jobs(state)
    live = state.map.live
    assert live is not None
    assert state.map.graph.closures >= 3
    assert live.rendered <= 4 * len(
        state.map.graph.submaps
    )  # once at each fourth keyframe of it, and when it is finished
    assert not live.busy()
    shown, final = live.grid(), render_map(state, CELL)
    xy = walls(final)
    to_wall = np.minimum(5.0 - np.abs(xy).max(axis=1), np.abs(np.hypot(*(np.abs(xy) - 2.5).T) - 0.25))
    assert np.percentile(np.abs(to_wall), 90) < 0.1
    assert agreement(shown, final) > 0.97
    packed = sum(len(one.patch.packed) for one in live.drawn.values())
    assert packed < 20_000 * len(live.drawn)
    forget_map(state)
    assert live.tiles
    assert live.grid().log_odds.size == 0


def agreement(a: Grid, b: Grid) -> float:
    """Share of the cells known to both on which they agree."""
    low = np.rint(np.maximum(a.origin, b.origin) / CELL).astype(int)
    high = [np.rint(g.origin / CELL).astype(int) + g.log_odds.shape[::-1] for g in (a, b)]
    wide, tall = np.minimum(*high) - low
    parts = []
    for g in (a, b):
        i, j = low - np.rint(g.origin / CELL).astype(int)
        parts.append(g.log_odds[j : j + tall, i : i + wide])
    both = (parts[0] != 0) & (parts[1] != 0)
    return float(((parts[0] > 0) == (parts[1] > 0))[both].mean())


# ---- moved furniture, through the whole pipeline


def furnished(table: tuple[float, float], shut: float) -> Scene:
    """10 x 8 m with a table, and a sliding door in its west wall, ``shut`` by that share, to a room behind."""
    x, y = table
    walls = [(-5, -4, 5, -4), (5, -4, 5, 4), (5, 4, -5, 4), (-5, 4, -5, 0.5), (-5, -0.5, -5, -4)]
    walls += [(-5, 0.5, -8, 2), (-8, 2, -8, -2), (-8, -2, -5, -0.5), *box(x - 0.6, y - 0.4, x + 0.6, y + 0.4)]
    walls += [(-5, 0.5, -5, 0.5 - shut)] if shut else []
    return Scene(np.array(walls, dtype=np.float64), (-5, -4), (5, 4))


def lap(state: State, begin: int, jobs: tuple[Job, ...], rng: np.random.Generator) -> tuple[Job, ...]:
    """Once round the room, 150 scans; ``begin``: number of the first. In the third lap somebody moves things."""
    angle = np.linspace(0.0, 2.0 * np.pi, 150, endpoint=False)
    x, y = 3.6 * np.cos(angle), 2.7 * np.sin(angle)
    truth = np.column_stack((x, y, np.arctan2(2.7 * np.cos(angle), -3.6 * np.sin(angle))))
    for k, T in enumerate(truth):
        t = 0.1 * (begin + k)
        done = min(max((begin + k - MOVING) / TAKES, 0.0), 1.0)
        x, y = (WAS + done * (IS_NOW - WAS)).tolist()
        scene = furnished((x, y), done)
        if begin + k == 0:
            state.motion.T_odom_base = state.map.T_map_start = T
        records: list[Record] = [Answer(t, job.job_id, job.run()) for job in jobs]
        if begin + k:
            records.append(Odometry(t - 0.1, t, se2.between(truth[k - 1], T)))
        scan = replace(scan_in(scene, T, bearings(181, 270.0), rng, t=t), seq=begin + k)
        jobs = step(state, [*records, scan], UNLIMITED).jobs
    return jobs


WAS, IS_NOW = np.array((0.0, 0.5)), np.array((0.3, -0.9))
"""Where the middle of the table is, before and after."""
MOVING, TAKES = 300, 30
"""First scan of the move, and scans that it takes: 3 s."""
TABLE = np.array([(dx, dy) for dx in np.linspace(-0.6, 0.6, 13) for dy in (-0.4, 0.4)])
DOOR = np.column_stack((np.full(18, -5.0), np.linspace(-0.45, 0.45, 18)))


def stands(points: Array, grid: Grid) -> float:
    """Share of points with an occupied cell beside them."""
    xy = walls(grid)
    return float((np.hypot(*(points[:, None] - xy).transpose(2, 0, 1)).min(axis=1) < 1.5 * CELL).mean())


@pytest.mark.jit
def test_moved_furniture_is_forgotten_in_one_pass() -> None:
    """A table is moved and a door shut after two laps; that lap over, every map says so, but for submaps left alone."""
    state, rng = new_state(Settings(live_m=CELL)), np.random.default_rng(1)
    jobs: tuple[Job, ...] = ()
    for number in range(3):
        jobs = lap(state, 150 * number, jobs, rng)
        live, local = state.map.live, state.matching.local_map
        assert live is not None
        assert local is not None
        if number == 1:
            assert stands(WAS + TABLE, live.grid()) > 0.9
    xy = se2.apply(state.pose.T_map_odom, local.elements[:, :2])
    near = np.hypot(*(xy[:, None] - (WAS + TABLE)).transpose(2, 0, 1)).min(axis=1) < 0.1
    assert near.sum() == 0
    for grid in (live.grid(), render_map(state, CELL)):
        assert stands(WAS + TABLE, grid) < 0.05
        assert stands(IS_NOW + TABLE, grid) > 0.9
        assert stands(DOOR, grid) > 0.9


def test_beams_that_say_nothing_make_no_tile() -> None:
    scan = Scan(0.0, 0.0, 0, np.zeros(3), HALF, np.zeros(181), np.full(181, Beam.NONE, np.uint8), 0.01)
    frame = keep(1, np.zeros(3), np.zeros(3), scan, 0.0)
    grid = at_once([(frame.submap, [frame])], 0.5)
    assert grid.log_odds.size == 0
