"""The beam model: a proper density, expected ranges beside a slow twin, and what separates true from false poses."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimator.measurements import Array, Beam, Scan
from estimator.numerics import se2
from estimator.paper import beam_model
from estimator.paper.beam_model import BeamModel
from tests.estimator.world import moved, scan_in
from tools.bench.support.scenes import bearings, office, paper_room

MODEL = BeamModel()
models = st.builds(
    BeamModel,
    hit=st.floats(0.01, 1.0),
    short=st.floats(0.0, 1.0),
    most=st.floats(0.0, 1.0),
    rand=st.floats(0.0, 1.0),
    sigma_m=st.floats(0.005, 0.5),
    decay=st.floats(0.05, 5.0),
    far_m=st.floats(3.0, 60.0),
)


def beams_of(scan: Scan) -> tuple[Array, Array, np.ndarray]:
    return scan.bearing_rad, scan.range_m, scan.beam


def segments_of(scan: Scan) -> Array:
    hit = scan.beam == Beam.HIT
    a, r = scan.bearing_rad[hit], scan.range_m[hit]
    return beam_model.segments_of(np.column_stack((r * np.cos(a), r * np.sin(a))))


def density_slow(z: float, expected: float, model: BeamModel) -> float:
    """Eq. 9's factor written down term by term."""
    total = model.hit + model.short + model.most + model.rand
    if not 0.0 <= z <= model.far_m:
        return 0.0
    p = model.rand / total / model.far_m
    if z <= expected:
        end = min(expected, model.far_m)
        p += model.short / total * model.decay * math.exp(-model.decay * z) / (1.0 - math.exp(-model.decay * end))
    if expected < model.far_m:

        def below(x: float) -> float:
            return 0.5 * math.erfc(-(x - expected) / (model.sigma_m * math.sqrt(2.0)))

        peak = 1.0 / (model.sigma_m * math.sqrt(2.0 * math.pi))
        bell = peak * math.exp(-0.5 * ((z - expected) / model.sigma_m) ** 2)
        p += model.hit / total * bell / (below(model.far_m) - below(0.0))
    return p


@settings(max_examples=25, deadline=None)
@given(models, st.floats(0.02, 80.0))
def test_all_that_a_beam_can_say_sums_to_one(model: BeamModel, expected: float) -> None:
    row, far = model.row(), model.far_m
    edges = {*np.linspace(0.0, far, 40), min(expected, far)}
    for k in range(-9, 10):
        edges.add(min(max(expected + k * model.sigma_m, 0.0), far))
    total = beam_model.silence(expected, row)
    nodes, weight = np.polynomial.legendre.leggauss(6)
    for a, b in zip(sorted(edges)[:-1], sorted(edges)[1:], strict=True):
        z = 0.5 * (a + b) + 0.5 * (b - a) * nodes
        total += 0.5 * (b - a) * sum(w * beam_model.density(x, expected, row) for w, x in zip(weight, z, strict=True))
    assert total == pytest.approx(1.0, abs=1e-6)


@given(models, st.floats(-1.0, 90.0), st.floats(0.02, 80.0))
def test_density_is_the_mixture(model: BeamModel, z: float, expected: float) -> None:
    assert beam_model.density(z, expected, model.row()) == pytest.approx(density_slow(z, expected, model), rel=1e-9)


def test_an_impossible_model_is_refused() -> None:
    with pytest.raises(ValueError, match="must not be negative"):
        BeamModel(short=-0.1).row()
    with pytest.raises(ValueError, match="must be positive"):
        BeamModel(sigma_m=0.0).row()
    with pytest.raises(ValueError, match="weights"):
        BeamModel(0.0, 0.0, 0.0, 0.0).row()


def cast_slow(segments: Array, eye: Array, bearing: Array) -> Array:
    """Every beam against every segment."""
    out = np.full(len(bearing), np.inf)
    for k, a in enumerate(bearing + eye[2]):
        u = np.array((math.cos(a), math.sin(a)))
        for x0, y0, x1, y1 in segments:
            p, d = np.array((x0, y0)) - eye[:2], np.array((x1 - x0, y1 - y0))
            det = u[1] * d[0] - u[0] * d[1]
            if det == 0.0:
                continue
            r, along = (p[1] * d[0] - p[0] * d[1]) / det, (u[0] * p[1] - u[1] * p[0]) / det
            if r > 0.0 and 0.0 <= along <= 1.0:
                out[k] = min(out[k], r)
    return out


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from([90.0, 180.0, 270.0, 359.0]), st.booleans())
def test_cast_ranges_are_those_of_the_slow_twin(seed: int, fov: float, mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    segments = rng.uniform(-3.0, 3.0, (12, 4))
    segments[:3, 2:] = segments[:3, :2] + rng.normal(0.0, 0.05, (3, 2))
    eye, bearing = np.array((*rng.uniform(-1.0, 1.0, 2), rng.uniform(-4.0, 4.0))), bearings(37, fov)
    bearing = np.ascontiguousarray(bearing[::-1]) if mirrored else bearing
    found = np.empty(len(bearing))
    beam_model.cast(segments, eye, bearing, found)
    np.testing.assert_allclose(found, cast_slow(segments, eye, bearing), rtol=1e-9)


def test_degenerate_surfaces_and_bearings_expect_nothing() -> None:
    found = np.empty(5)
    beam_model.cast(np.empty((0, 4)), np.zeros(3), bearings(5, 90.0), found)
    assert np.isinf(found).all()
    radial = np.array(((1.0, 0.0, 2.0, 0.0), (1.0, 1.0, 1.0, 1.0)))
    beam_model.cast(radial, np.zeros(3), bearings(5, 90.0), found)
    assert np.isinf(found).all()
    beam_model.cast(radial, np.zeros(3), np.zeros(5), found)
    assert np.isinf(found).all()
    assert beam_model.segments_of(np.zeros((1, 2))).shape == (0, 4)


def test_neighbours_across_a_gap_are_no_surface() -> None:
    xy = np.array(((1.0, 0.0), (1.0, 0.1), (1.0, 1.0), (1.0, 1.1)))
    assert len(beam_model.segments_of(xy)) == 2


def test_a_beam_that_says_nothing_changes_nothing() -> None:
    wall = np.array(((2.0, -3.0, 2.0, 3.0),))
    bearing, kind = bearings(7, 60.0), np.full(7, Beam.HIT, np.uint8)
    distance = 2.0 / np.cos(bearing)
    whole = beam_model.log_likelihood(wall, np.zeros(3), (bearing, distance, kind), MODEL, 1.0)
    for bad in (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e9):
        spoilt = distance.copy()
        spoilt[3] = bad
        left = beam_model.log_likelihood(wall, np.zeros(3), (bearing, spoilt, kind), MODEL, 1.0)
        assert left == pytest.approx(whole * 6.0 / 7.0, rel=0.02)
    kind[:] = Beam.NONE
    assert beam_model.log_likelihood(wall, np.zeros(3), (bearing, distance, kind), MODEL, 1.0) == 0.0
    assert math.isnan(beam_model.quality(wall, np.zeros(3), (bearing, distance, kind), MODEL))
    assert beam_model.mean_log(wall, np.zeros(3), (bearing, distance, kind), MODEL) == -math.inf
    kind[:] = Beam.FREE
    through = beam_model.log_likelihood(wall, np.zeros(3), (bearing, distance + 5.0, kind), MODEL, 1.0)
    assert through == pytest.approx(7.0 * math.log(MODEL.row()[beam_model.MAX]))


def test_tempering_is_monotone_and_only_blunts() -> None:
    scan = scan_in(paper_room(), np.zeros(3), bearings(181, 180.0), None)
    segments, here = segments_of(scan), beams_of(scan)
    true, false = np.zeros(3), np.array((0.4, 0.3, 0.2))
    before = [beam_model.log_likelihood(segments, T, here, MODEL, 1.0) for T in (true, false)]
    assert before[0] > before[1] + 10.0
    for c in (1.5, 7.0, 40.0, 181.0, 1e4):
        good, bad = (beam_model.log_likelihood(segments, T, here, MODEL, c) for T in (true, false))
        assert good > bad
        assert abs(good) < abs(before[0])
        assert good - bad < before[0] - before[1]
        before = [good, bad]


def test_sharpening_is_refused() -> None:
    scan = scan_in(paper_room(), np.zeros(3), bearings(31, 180.0), None)
    with pytest.raises(ValueError, match="below 1"):
        beam_model.log_likelihood(segments_of(scan), np.zeros(3), beams_of(scan), MODEL, 0.5)


@pytest.mark.jit
def test_it_tells_true_from_false_poses() -> None:
    """Poses 0.4 m and 12 deg off explain a scan worse than the true one, by far and nearly always."""
    rng, bearing = np.random.default_rng(6), bearings(361, 270.0)
    for scene in (paper_room(), office()):
        margin = []
        for _ in range(40):
            T = scene.place(rng)
            segments = segments_of(scan_in(scene, T, bearing, rng))
            T_new = moved(T, rng, 0.1, 0.03)
            new = scan_in(scene, T_new, bearing, rng)
            true = se2.between(T, T_new)
            said = [
                beam_model.quality(segments, pose, beams_of(new), MODEL) for pose in (true, moved(true, rng, 0.4, 0.2))
            ]
            margin.append(said[0] - said[1])
        assert np.mean(np.array(margin) > 0.3) > 0.95
