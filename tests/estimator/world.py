"""Scans in plain rooms, for the estimator's tests: the truth is known, the noise is Gaussian, nothing else happens."""

import numpy as np

from estimator.mapping.keyframe import keep
from estimator.measurements import Array, Beam, Scan
from estimator.numerics import se2
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints, oriented, points_of
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import LocalMap, MapSettings
from estimator.scan_matching.scan_matcher import Prior, View
from tools.bench.support.scenes import Scene

STILL = np.zeros(3)


def scan_in(
    scene: Scene, T: Array, bearing: Array, rng: np.random.Generator | None, sigma: float = 0.01, t: float = 0.0
) -> Scan:
    """What a lidar at ``T`` measures; without ``rng`` exactly."""
    distance = scene.ranges(T, bearing)
    seen = np.isfinite(distance)
    distance = np.where(seen, distance, 0.0)
    if rng is not None:
        distance = distance + np.where(seen, rng.normal(0.0, sigma, len(distance)), 0.0)
    return Scan(t, t, 0, STILL.copy(), bearing, distance, np.where(seen, Beam.HIT, Beam.NONE).astype(np.uint8), sigma)


def points_in(scan: Scan) -> ScanPoints:
    return points_of(scan, STILL, 80.0, 0.0)


def map_of(scans: list[tuple[Array, Scan]], settings: MapSettings | None = None) -> LocalMap:
    """Local map of scans seen from known poses."""
    local = local_map.empty(scans[0][0][:2])
    for key, (T, scan) in enumerate(scans):
        frame = keep(key, T, T, scan, 0.0)
        local = local_map.update(local, frame, lines_of(points_in(scan)), settings or MapSettings(), scan.sigma_m)
    return local


def view_of(scan: Scan) -> View:
    return View(
        oriented(points_in(scan), 100_000), scan.T_base_lidar, (scan.bearing_rad, scan.range_m, scan.beam), scan.sigma_m
    )


def prior_at(T: Array, sd_m: float, sd_rad: float) -> Prior:
    return Prior(T, np.diag((sd_m**-2, sd_m**-2, sd_rad**-2)))


def moved(T: Array, rng: np.random.Generator, metres: float, radians: float) -> Array:
    """``T`` displaced by exactly so much, in a random direction."""
    a = rng.uniform(-np.pi, np.pi)
    return se2.compose(T, np.array((metres * np.cos(a), metres * np.sin(a), radians * rng.choice((-1.0, 1.0)))))


def place_both(scene: Scene, rng: np.random.Generator, metres: float, radians: float) -> tuple[Array, Array]:
    """Two poses that far apart with room around both."""
    while True:
        T = scene.place(rng)
        T_new = moved(T, rng, metres, radians)
        if scene.clear(T_new, 0.2):
            return T, T_new
