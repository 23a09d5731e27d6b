"""Line elements: where surfaces are, which way they face, and how well that is known."""

import numpy as np
import pytest

from estimator.measurements import Array
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.line_features import (
    REACH_M,
    SPACING_M,
    add_up,
    line_through,
    lines_of,
    neighbours,
    offset_on_line,
)
from tests.estimator.world import points_in, scan_in
from tools.bench.support.scenes import Scene, bearings, box, paper_room

ORIGIN = np.zeros(2)


def points(xy: Array, sigma: float = 0.01) -> ScanPoints:
    return ScanPoints(np.ascontiguousarray(xy), ORIGIN, 0.0, sigma)


def wall(n: int, spacing: float, noise: Array | float = 0.0) -> Array:
    x = (np.arange(n) - (n - 1) / 2.0) * spacing
    return np.column_stack((x, 2.0 + noise * np.ones(n)))


def test_a_wall_faces_the_sensor() -> None:
    lines = lines_of(points(wall(41, 0.02)))
    assert len(lines) == 41
    np.testing.assert_allclose(lines[:, 1], 2.0, atol=1e-9)
    np.testing.assert_allclose(lines[:, 2:4], np.tile((0.0, -1.0), (41, 1)), atol=1e-9)
    np.testing.assert_allclose(lines[:, 5], 0.8)


def test_sparse_beams_use_their_neighbours_and_no_others() -> None:
    assert neighbours(wall(9, 0.3), 4, REACH_M) == (3, 6)  # beyond half a metre nothing belongs together
    assert neighbours(wall(9, 0.2), 4, REACH_M) == (2, 7)  # two on either side
    assert neighbours(wall(41, 0.02), 20, REACH_M) == (14, 27)  # all within 12 cm
    assert len(lines_of(points(wall(9, 0.6)))) == 0


def test_runs_are_measured_end_to_end() -> None:
    xy = np.vstack((wall(11, 0.02), wall(11, 0.02) + np.array((3.0, 0.0))))
    np.testing.assert_allclose(lines_of(points(xy))[:, 5], 0.2)


@pytest.mark.parametrize("away", [0.5, 8.0, 80.0])
def test_a_line_and_its_parabola_are_those_of_the_definition(away: float) -> None:
    """Running sums lose nothing that matters: normal and variances as by eigenvectors, offset as by least squares."""
    rng, eye = np.random.default_rng(1), np.array((3.0, -2.0))
    u = np.linspace(-0.12, 0.12, 200)
    xy = np.column_stack((u, 0.5 * u**2)) + rng.normal(0.0, 0.003, (200, 2))
    c, s = np.cos(0.7), np.sin(0.7)
    xy = np.ascontiguousarray(xy @ np.array(((c, s), (-s, c))) + eye + away * np.array((0.6, 0.8)))
    sums, columns, here = np.empty((201, 5)), np.empty((2, 200)), xy[100]
    add_up(xy, eye, sums, columns)
    np.testing.assert_array_equal(columns, xy.T)
    for low, high in ((60, 140), (95, 104), (99, 102)):
        nx, ny, across, along = line_through(sums, low, high)
        w, V = np.linalg.eigh(np.cov(xy[low:high].T, bias=True))
        np.testing.assert_allclose((across, along), w, rtol=1e-9, atol=1e-3 * 0.0001**2 * away**2)
        assert abs(V[:, 0] @ (nx, ny)) == pytest.approx(1.0, abs=1e-9)
        local = (xy[low:high] - here) @ np.array(((ny, nx), (-nx, ny)))
        degree = 2 if high - low >= 5 else 1
        expected = np.polynomial.polynomial.polyfit(local[:, 0], local[:, 1], degree)[0]
        found = offset_on_line(columns, low, high, (here[0], here[1], nx, ny))
        assert found == pytest.approx(expected, abs=1e-9)


def test_dense_points_make_no_more_lines_than_a_surface_needs() -> None:
    """Two millimetres apart: a line every 1.8 cm, and a step in the wall begins a new one at once."""
    lines = lines_of(points(wall(501, 0.002)))
    gaps = np.hypot(*np.diff(lines[:, :2], axis=0).T)
    assert ((gaps > SPACING_M - 1e-9) & (gaps < SPACING_M + 0.0021)).all()
    step = np.vstack((wall(101, 0.002), wall(101, 0.002) + np.array((0.202, 0.3))))
    found = lines_of(points(step))
    for y in (2.0, 2.3):
        x = found[np.abs(found[:, 1] - y) < 0.01, 0]
        wanted = (-0.1, 0.1) if y == 2.0 else (0.102, 0.302)
        assert abs(x.min() - wanted[0]) < 2.0 * SPACING_M
        assert abs(x.max() - wanted[1]) < 2.0 * SPACING_M


def test_what_is_no_line_is_left_out() -> None:
    assert len(lines_of(points(np.empty((0, 2))))) == 0
    assert len(lines_of(points(np.full((30, 2), 1.0)))) == 0
    cloud = np.random.default_rng(0).uniform(-0.1, 0.1, (60, 2)) + 2.0
    assert len(lines_of(points(cloud))) <= 20  # a few neighbours are in line by chance


@pytest.mark.jit
def test_the_variance_of_a_direction_is_what_noise_makes_it() -> None:
    rng = np.random.default_rng(2)
    directions, said = [], []
    for _ in range(400):
        lines = lines_of(points(wall(31, 0.02, rng.normal(0.0, 0.01, 31))))
        directions.append(np.arctan2(lines[15, 2], -lines[15, 3]))
        said.append(lines[15, 4])
    assert np.median(said) == pytest.approx(np.var(directions), rel=0.25)


@pytest.mark.jit
def test_noise_does_not_cut_the_surroundings_short() -> None:
    """Beams 4 mm apart with 3 cm of noise, a wall near by: the directions are as sure as they are said to be."""
    rng = np.random.default_rng(4)
    share = []
    for _ in range(40):
        lines = lines_of(points(wall(401, 0.004, rng.normal(0.0, 0.03, 401)), sigma=0.03))
        lines = lines[np.abs(lines[:, 0]) < 0.56]
        share.append(np.mean(lines[:, 2] ** 2 / lines[:, 4]))
    assert 0.5 < np.mean(share) < 1.2


@pytest.mark.jit
def test_a_column_is_not_drawn_inwards() -> None:
    """The mean distance of the elements from the column's middle is its radius to a millimetre, and no chord's."""
    rng = np.random.default_rng(3)
    scene = paper_room()
    radii = []
    for _ in range(40):
        scan = scan_in(scene, np.array((0.5, 2.5, 0.0)), bearings(361, 90.0), rng)
        lines = lines_of(points_in(scan))
        r = np.hypot(*(lines[:, :2] + np.array((0.5, 2.5)) - scene.columns[3, :2]).T)
        radii.append(r[r < 0.4])
    assert np.mean(np.concatenate(radii)) == pytest.approx(0.25, abs=1.5e-3)


def test_corners_of_a_room_keep_their_walls_apart() -> None:
    scene = Scene(np.array(box(-2, -2, 2, 2), dtype=np.float64), (-1, -1), (1, 1))
    scan = scan_in(scene, np.zeros(3), bearings(721, 180.0), np.random.default_rng(1))
    lines = lines_of(points_in(scan))
    along_axes = np.maximum(np.abs(lines[:, 2]), np.abs(lines[:, 3]))
    assert np.percentile(along_axes, 5) > np.cos(np.radians(8.0))
    off = np.minimum(np.abs(np.abs(lines[:, 0]) - 2.0), np.abs(np.abs(lines[:, 1]) - 2.0))
    assert np.sqrt(np.mean(off**2)) < 0.008
