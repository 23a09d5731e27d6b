"""What speaks for and against a pose: the kernels against their definitions."""

from __future__ import annotations

import numpy as np
import pytest

from estimator.measurements import Array, Beam
from estimator.numerics import se2
from estimator.scan_matching import icp
from estimator.scan_matching.local_map import MARGIN, SAMPLES, LocalMap, contradicted, look_at
from estimator.scan_matching.scan_matcher import FEW, Attempt, MatchSettings, View, attempt, held
from tests.estimator.world import map_of, prior_at, scan_in, view_of
from tools.bench.support.scenes import bearings, office, paper_room

SETTINGS = MatchSettings()
NOISE = 0.01


def scene_of(beams: int, rng: np.random.Generator) -> tuple[LocalMap, View, Attempt]:
    """A map of two scans, a third, and where it was found."""
    scene = office() if beams > 200 else paper_room()
    T, bearing = scene.place(rng), bearings(beams, 200.0)
    seen = [(pose, scan_in(scene, pose, bearing, rng)) for pose in (T, T + np.array((0.05, 0.02, 0.3)))]
    local, view = map_of(seen), view_of(scan_in(scene, T, bearing, rng))
    return local, view, attempt(view, local, prior_at(T, 0.1, 0.1), 30, SETTINGS)


def said_of(points: Array, eye: Array, beams: tuple[Array, Array, np.ndarray]) -> np.ndarray:
    said = np.empty(len(points), np.int8)
    look_at(points, eye, beams, MARGIN + 5.0 * NOISE, 1, said)
    return said


@pytest.mark.parametrize("beams", [91, pytest.param(1081, marks=pytest.mark.jit)])
def test_evidence_is_elements_looked_through_and_points_that_hang_in_space(beams: int) -> None:
    rng = np.random.default_rng(beams)
    local, view, found = scene_of(beams, rng)
    eye = found.T + rng.normal(0.0, 0.2, 3)
    assert local.newest is not None
    said = said_of(np.ascontiguousarray(local.elements[:: max(1, len(local.elements) // SAMPLES)]), eye, view.beams)
    bearing, distance, kind = view.beams
    hit = np.flatnonzero(kind == Beam.HIT)
    hit = hit[:: max(1, len(hit) // SAMPLES)]
    ends = np.column_stack((distance[hit] * np.cos(bearing[hit]), distance[hit] * np.sin(bearing[hit])))
    points = np.hstack((se2.apply(eye, ends), np.zeros((len(hit), 2))))
    said = np.concatenate((said, said_of(points, local.newest.T_odom_lidar, local.newest.beams())))
    against, told = int((said < 0).sum()), int((said != 0).sum())
    assert told > len(said) // 4
    assert contradicted(local, eye, view.beams, NOISE) == pytest.approx(against / told, abs=1e-12)
    assert contradicted(local, found.T, view.beams, NOISE) < 0.05


@pytest.mark.parametrize("beams", [91, pytest.param(1081, marks=pytest.mark.jit)])
def test_what_is_held_is_the_least_share_of_surface_that_fits(beams: int) -> None:
    """By generalized eigenvalues over every point, paired afresh."""
    local, view, found = scene_of(beams, np.random.default_rng(beams))
    axis, scale = local.axis, SETTINGS.scale * NOISE
    assert held(found, local, SETTINGS) > 0.9
    found.T = found.T + np.array((0.06, -0.04, 0.01))
    T = found.T - np.array((*axis.centre, 0.0))
    seen, fitting = FEW * np.eye(2), FEW * np.eye(2)
    for x, y, tx, ty in view.points:
        p, t = se2.apply(T, np.array(((x, y),)))[0], se2.rotation(T[2])[:2, :2] @ (tx, ty)
        across = np.array((-t[1], t[0]))
        seen += np.outer(across, across)
        d = np.hypot(*(axis.rows[:, :2] - p).T)
        n = local.lines[int(d.argmin()), :2]
        off = abs(n @ (p - axis.rows[int(d.argmin()), :2]))
        if d.min() < max(6.0 * scale, 0.1) and off < 2.0 * scale and abs(n @ t) < icp.ASKEW:
            fitting += np.outer(across, across)
    least = np.linalg.eigvals(np.linalg.solve(seen, fitting)).real.min()
    assert least < 0.9
    assert held(found, local, SETTINGS) == pytest.approx(least, abs=1e-9)
    found.H = np.diag((0.0, 1e6, 1e6))
    assert held(found, local, SETTINGS) == pytest.approx(fitting[1, 1] / seen[1, 1], abs=1e-9)
    found.H = np.diag((1e6, 0.0, 1e6))
    assert held(found, local, SETTINGS) == pytest.approx(fitting[0, 0] / seen[0, 0], abs=1e-9)
    found.H = np.diag((0.0, 0.0, 1e6))
    assert held(found, local, SETTINGS) == 1.0
