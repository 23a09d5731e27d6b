"""From beams to points: the filter, the mount, and the motion during the scan."""

import dataclasses

import numpy as np
import pytest

from estimator.mapping.keyframe import keep
from estimator.measurements import Array, Beam, Scan
from estimator.numerics import se2
from estimator.scan_matching.deskew import points_of, unturned
from tools.bench.support.scenes import bearings, paper_room

STILL = np.zeros(3)


def scan_of(ranges: Array, bearing: Array, mount: Array = STILL) -> Scan:
    kind = np.full(len(ranges), Beam.HIT, np.uint8)
    return Scan(0.0, 0.025, 0, mount, bearing, ranges, kind, 0.01)


def sweep(T_end: Array, motion: Array, mount: Array, bearing: Array) -> Array:
    """Ranges of a lidar that makes ``motion`` while it sweeps: every beam from a pose of its own."""
    twist, n = se2.log(motion), len(bearing)
    out = np.empty(n)
    for i in range(n):
        T = se2.compose(T_end, se2.exp(twist * (i / (n - 1) - 1.0)))
        out[i] = paper_room().ranges(se2.compose(T, mount), bearing[i : i + 1])[0]
    return out


def test_a_moving_scan_is_put_right() -> None:
    """1.5 m/s and 1.5 rad/s over 25 ms skew the room by centimetres; what is left is below a millimetre."""
    bearing, mount = bearings(121, 240.0), np.array((0.15, -0.03, 0.3))
    T_end, motion = np.array((1.0, -0.5, 0.4)), np.array((0.0375, 0.004, 0.0375))
    ranges = sweep(T_end, motion, mount, bearing)
    exact = paper_room().ranges(se2.compose(T_end, mount), bearing)
    assert np.abs(ranges - exact).max() > 0.02
    points = points_of(scan_of(ranges, bearing, mount), motion, 80.0, 0.0)
    world = se2.apply(T_end, points.xy)
    walls = np.abs(np.abs(world) - 5.0).min(axis=1)
    columns = np.abs(np.hypot(*(world[:, None] - paper_room().columns[None, :, :2]).T) - 0.25).min(axis=0)
    assert np.minimum(walls, columns).max() < 1e-3
    assert points.turned_rad == motion[2]
    np.testing.assert_array_equal(points.origin, mount[:2])


@pytest.mark.parametrize("uneven", [0.0, 1e-6, 1e-3])
@pytest.mark.parametrize("motion", [(0.0, 0.0, 0.0), (0.04, -0.01, 0.06)])
def test_every_beam_is_where_its_own_sine_and_cosine_put_it(uneven: float, motion: tuple[float, ...]) -> None:
    """A thousand beams, at even bearings, nearly even, and not: as by the definition, beam by beam."""
    rng, mount, n = np.random.default_rng(0), np.array((0.15, -0.03, 0.3)), 1081
    bearing = bearings(n, 270.0) + rng.uniform(-uneven, uneven, n)
    ranges = rng.uniform(0.1, 30.0, n)
    points = points_of(scan_of(ranges, bearing, mount), np.array(motion), 80.0, 0.0)
    twist, expected = se2.log(np.array(motion)), np.empty((n, 2))
    for i in range(n):
        vx, vy, w = twist * (i - n + 1) / (n - 1)
        end = se2.compose(mount, np.array((0.0, 0.0, bearing[i])))
        x, y = se2.apply(end, np.array(((ranges[i], 0.0),)))[0]
        c, s = np.cos(w), np.sin(w)
        expected[i] = vx - 0.5 * w * vy + c * x - s * y, vy + 0.5 * w * vx + s * x + c * y
    np.testing.assert_allclose(points.xy, expected, atol=3e-9)


def test_a_bearing_that_is_no_number_is_left_out() -> None:
    for at in (0, 3, 8):
        bearing = np.linspace(-1.0, 1.0, 9)
        bearing[at] = np.nan
        points = points_of(scan_of(np.ones(9), bearing), np.array((0.1, 0.0, 0.1)), 80.0, 0.0)
        assert points.xy.shape == (8, 2)
        assert np.isfinite(points.xy).all()


def test_unturned_bearings_point_where_the_beams_went() -> None:
    bearing, turned = bearings(11, 240.0), 0.05
    seen = unturned(bearing, turned)
    assert seen[-1] == bearing[-1]
    assert seen[0] == pytest.approx(bearing[0] - turned)
    np.testing.assert_allclose(np.diff(seen), np.diff(seen)[0])
    assert unturned(bearing, 0.0) is bearing


def test_the_filter_keeps_what_may_be_used() -> None:
    bearing = np.zeros(9)
    ranges = np.array((1.0, -1.0, 0.0, np.nan, np.inf, 90.0, 2.0, 3.0, 4.0))
    scan = scan_of(ranges, bearing)
    scan.beam[6] = Beam.FREE
    scan = dataclasses.replace(scan, intensity=np.array((9.0,) * 7 + (1.0, 9.0)))
    np.testing.assert_allclose(points_of(scan, STILL, 80.0, 5.0).xy[:, 0], (1.0, 4.0))
    np.testing.assert_allclose(points_of(scan, STILL, 3.5, 0.0).xy[:, 0], (1.0, 3.0))
    none = dataclasses.replace(scan, intensity=None)
    np.testing.assert_allclose(points_of(none, STILL, 80.0, 5.0).xy[:, 0], (1.0, 3.0, 4.0))


@pytest.mark.parametrize("n", [0, 1])
def test_tiny_scans(n: int) -> None:
    points = points_of(scan_of(np.ones(n), np.zeros(n)), np.array((0.1, 0.0, 0.1)), 80.0, 0.0)
    assert points.xy.shape == (n, 2)
    assert np.isfinite(points.xy).all()


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    scan = dataclasses.replace(scan_of(np.ones(5), np.zeros(5)), range_m=np.ones(4))
    with pytest.raises(ValueError, match="5 bearings, 4 ranges"):
        points_of(scan, STILL, 80.0, 0.0)


def test_a_keyframe_keeps_the_beams_small() -> None:
    scan = scan_of(np.linspace(1.0, 2.0, 7), bearings(7, 90.0))
    frame = keep(3, np.array((1.0, 2.0, 0.0)), np.array((0.5, 0.0, 0.0)), scan, 0.02)
    bearing, distance, kind = frame.beams()
    assert frame.range_m.dtype == np.float32
    assert distance.dtype == np.float64
    np.testing.assert_allclose(distance, scan.range_m, rtol=1e-6)
    np.testing.assert_allclose(bearing, unturned(scan.bearing_rad, 0.02))
    assert kind is scan.beam
    np.testing.assert_allclose(frame.T_odom_lidar, (0.5, 0.0, 0.0))
