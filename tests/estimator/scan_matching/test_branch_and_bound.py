"""Search for a place without any idea of it: exact against trying everything, ambiguity in plain sight."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.measurements import Array
from estimator.numerics import se2
from estimator.scan_matching.branch_and_bound import LEVELS, SPREAD, Field, SearchSettings, field_of, score_at, search
from tools.bench.support.scenes import Scene, bearings, office, paper_room

FEW, MANY = bearings(120, 270.0), bearings(720, 270.0)


def points_from(scene: Scene, T: Array, bearing: Array = FEW) -> Array:
    r = scene.ranges(T, bearing)
    seen = np.isfinite(r)
    return np.column_stack((r * np.cos(bearing), r * np.sin(bearing)))[seen]


def map_of(scene: Scene, seed: int = 0, places: int = 100) -> Field:
    rng = np.random.default_rng(seed)
    seen = []
    for _ in range(places):
        T = scene.place(rng)
        seen.append(se2.apply(T, points_from(scene, T, MANY)))
    return field_of(np.concatenate(seen))


def scores_slow(field: Field, points: Array, headings: int) -> Array:
    """Score of every cell at every heading, by the definition."""
    height, width = field.pyramid.shape[1:]
    out = np.zeros((headings, height, width))
    for h in range(headings):
        turned = se2.apply(np.array((0.0, 0.0, 2.0 * np.pi * h / headings)), points)
        for column, row in np.floor(turned / field.resolution + 0.5).astype(int):
            r, c = np.arange(height) + row, np.arange(width) + column
            inside = np.ix_((r >= 0) & (r < height), (c >= 0) & (c < width))
            out[h][inside] += field.pyramid[0][np.ix_(r[(r >= 0) & (r < height)], c[(c >= 0) & (c < width)])] / 255.0
    return out / len(points)


@pytest.mark.jit
@given(seed=st.integers(0, 1000), n=st.integers(1, 12))
@settings(max_examples=25, deadline=None)
def test_the_best_place_is_the_best_there_is(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    field = field_of(rng.uniform(0.0, 3.0, (30, 2)), resolution=0.1, sigma_m=0.1, reach_m=0.5)
    points = rng.uniform(-1.5, 1.5, (n, 2))
    headings = 16
    found = search(field, points, SearchSettings(least=0.01, hits=1, heading_rad=2.0 * np.pi / headings))
    assert found.complete
    assert found.hits[0].score == pytest.approx(scores_slow(field, points, headings).max(), abs=1e-12)


def test_every_level_bounds_the_finest() -> None:
    rng = np.random.default_rng(0)
    field = field_of(rng.uniform(0.0, 2.0, (20, 2)), resolution=0.1, sigma_m=0.1, reach_m=0.5)
    cells = rng.integers(-20, 20, (15, 2)).astype(np.int32)
    for level in range(1, 5):
        for c in range(0, 16, 3):
            for r in range(0, 16, 3):
                inside = [
                    score_at(field.pyramid, cells, 0, c + i, r + j)
                    for i in range(1 << level)
                    for j in range(1 << level)
                ]
                assert score_at(field.pyramid, cells, level, c, r) >= max(inside) - 1e-12
    assert len(field.pyramid) == LEVELS


def test_the_field_is_the_likelihood_of_the_nearest_point() -> None:
    points = np.array(((0.0, 0.0), (0.33, 0.11)))
    field = field_of(points, resolution=0.05, sigma_m=0.05, reach_m=0.3)
    height, width = field.pyramid.shape[1:]
    c, r = np.meshgrid(np.arange(width), np.arange(height))
    centre = field.origin + 0.05 * np.stack((c + 0.5, r + 0.5), axis=-1)
    d = np.min(np.hypot(*(centre[:, :, None] - points).transpose(3, 0, 1, 2)), axis=2) / 0.05
    expected = np.where(d < SPREAD, np.floor(255.0 * np.exp(-0.5 * d**2) + 0.5), 0.0)
    np.testing.assert_allclose(field.pyramid[0], expected, atol=1.0)


@pytest.mark.jit
def test_a_place_in_an_office_is_found() -> None:
    scene, rng = office(), np.random.default_rng(3)
    field = map_of(scene)
    for _ in range(4):
        T = scene.place(rng)
        found = search(field, points_from(scene, T), SearchSettings(hits=2))
        away = se2.between(T, found.hits[0].T_map_lidar)
        assert np.hypot(away[0], away[1]) < 0.15
        assert abs(away[2]) < 0.05
        assert found.hits[1].score < 0.95 * found.hits[0].score


@pytest.mark.jit
def test_a_symmetric_room_shows_all_its_places() -> None:
    """A square room with four columns looks the same from four places, a quarter turn apart."""
    scene, T = paper_room(), np.array((2.0, 0.7, 0.4))
    found = search(map_of(scene), points_from(scene, T), SearchSettings(hits=5))
    assert [hit.score > 0.95 * found.hits[0].score for hit in found.hits] == [True] * 4 + [False] * (
        len(found.hits) - 4
    )
    for quarter in range(4):
        alias = se2.compose(np.array((0.0, 0.0, quarter * np.pi / 2)), T)
        away = [se2.between(alias, hit.T_map_lidar) for hit in found.hits[:4]]
        assert min(np.hypot(d[0], d[1]) + abs(d[2]) for d in away) < 0.2


@pytest.mark.jit
def test_the_cap_ends_a_search_and_says_so() -> None:
    scene = office()
    found = search(map_of(scene), points_from(scene, np.array((2.0, 6.0, 0.0))), SearchSettings(nodes=500))
    assert not found.complete
    assert found.nodes < 1000 + 700 * 60


def test_a_scan_from_elsewhere_finds_nothing() -> None:
    field = field_of(np.array(((0.0, 0.0), (0.1, 0.0), (0.2, 0.0))), reach_m=0.2)
    found = search(field, np.random.default_rng(0).uniform(-3, 3, (40, 2)), SearchSettings(heading_rad=0.5))
    assert found.hits == ()
    assert found.complete


def test_what_is_no_map_or_no_scan_is_refused() -> None:
    with pytest.raises(ValueError, match="a map of 0 points"):
        field_of(np.empty((0, 2)))
    with pytest.raises(ValueError, match="all of them finite"):
        field_of(np.array(((0.0, np.nan),)))
    with pytest.raises(ValueError, match="without points"):
        search(field_of(np.zeros((1, 2))), np.empty((0, 2)))
