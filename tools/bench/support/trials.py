"""Matches by the thousand in rooms whose truth is known: what they miss by, and whether they say so.

Any matcher that is called as ``matcher(view, local, prior) -> MatchResult`` can be put on trial, see :func:`run`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.mapping.keyframe import keep
from estimator.measurements import UNLIMITED, Array, Beam, Scan
from estimator.numerics import se2
from estimator.result import MatchResult
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import oriented, points_of
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import LocalMap, MapSettings
from estimator.scan_matching.scan_matcher import MatchSettings, Prior, View, match
from tools.bench.support.bound import bound
from tools.bench.support.scenes import Scene, bearings

Flags = npt.NDArray[np.bool_]
Matcher = Callable[[View, LocalMap, Prior], MatchResult]

STILL: Final = np.zeros(3)
SETTINGS: Final = MatchSettings()
ours: Final[Matcher] = partial(match, cap=UNLIMITED.icp_iterations, settings=SETTINGS)

CLOSE_M, CLOSE_DEG = 0.02, 0.5
"""A match within these has succeeded."""

CHI2_3, CHI2_2, CHI2_3_999 = 7.815, 5.991, 16.27
"""95 % of squared Mahalanobis distances of three and two dimensions; 99.9 % of three."""


@dataclass(frozen=True)
class Case:
    """What is tried.

    Attributes:
        off: how wrong the prediction is (m, deg), exactly, in a random direction. sigma: range noise, m.
        scans: the map is made of so many, the first from where the prediction lies, the others within half a metre.
        prior: standard deviations (m, rad) the prediction is said to have.
    """

    scene: Scene
    beams: int = 1081
    fov: float = 270.0
    off: tuple[float, float] = (0.17, 4.0)
    sigma: float = 0.01
    scans: int = 1
    prior: tuple[float, float] = (0.5, 0.35)


@dataclass(eq=False)
class Trials:
    """Outcomes of n trials.

    Attributes:
        error: pose minus truth (n, 3), world axes. results: what the matcher said.
        least: bound on the covariance (n, 3, 3). truths: where the second scan was taken (n, 3).
    """

    error: Array
    results: list[MatchResult]
    least: Array
    truths: Array
    ok: Flags = field(init=False)
    information: Array = field(init=False)

    def __post_init__(self) -> None:
        self.ok = np.array([result.ok for result in self.results])
        self.information = np.array([result.information for result in self.results])

    @property
    def metres(self) -> Array:
        """Position errors (n,)."""
        return np.hypot(self.error[:, 0], self.error[:, 1])

    @property
    def degrees(self) -> Array:
        """Heading errors (n,)."""
        return np.degrees(np.abs(self.error[:, 2]))

    @property
    def close(self) -> Flags:
        """Which came within 2 cm and 0.5 deg, and say so."""
        return self.ok & (self.metres <= CLOSE_M) & (self.degrees <= CLOSE_DEG)

    @property
    def possible(self) -> Flags:
        """Where the bound allows success: a quarter of the limits, so that noise alone fails one in ten thousand."""
        least = np.linalg.eigvalsh(self.least[:, :2, :2])[:, 1]
        return (least < (0.25 * CLOSE_M) ** 2) & (self.least[:, 2, 2] < np.radians(0.25 * CLOSE_DEG) ** 2)

    @property
    def distance2(self) -> Array:
        """Squared Mahalanobis distance of each error by the reported information (n,)."""
        return np.einsum("ni,nij,nj->n", self.error, self.information, self.error)

    @property
    def success(self) -> float:
        """Share that came close of the trials in which that is possible."""
        return float(self.close[self.possible].mean())

    @property
    def confident_wrong(self) -> int:
        """Results that are neither close nor within their own 99.9 % ellipsoid.

        One honest result in twenty leaves the 95 % one, which may be wider than 2 cm where there is much noise.
        """
        return int((self.ok & ~self.close & (self.distance2 > CHI2_3_999)).sum())

    @property
    def inside(self) -> float:
        """Share of the results whose error is inside the reported 95 % ellipsoid."""
        return float((self.distance2[self.ok] < CHI2_3).mean())

    def rms(self) -> tuple[float, float]:
        """RMS position (m) and heading (deg) error of what came close."""
        good = self.close & self.possible
        return root_mean(self.metres[good] ** 2), root_mean(self.degrees[good] ** 2)

    def rms_bound(self) -> tuple[float, float]:
        """The Cramer-Rao bound on the same."""
        least = self.least[self.close & self.possible]
        return root_mean(least[:, 0, 0] + least[:, 1, 1]), float(np.degrees(root_mean(least[:, 2, 2])))


def root_mean(squares: Array) -> float:
    """Root of the mean."""
    return float(np.sqrt(squares.mean()))


def run(case: Case, count: int, seed: int = 11, matcher: Matcher = ours) -> Trials:
    """So many matches, each in its own place with its own noise; the same ones for every matcher."""
    said: list[MatchResult] = []
    errors, least, truths = [], [], []
    for number in range(count):
        view, local, prior, T_new = given(case, seed, number)
        result = matcher(view, local, prior)
        error = result.T_odom_base - T_new
        error[2] = se2.wrap(error[2])
        said.append(result)
        errors.append(error)
        least.append(bound(case.scene, prior.T, T_new, bearings(case.beams, case.fov), case.sigma, case.scans))
        truths.append(T_new)
    return Trials(np.array(errors), said, np.array(least), np.array(truths))


def given(case: Case, seed: int, number: int) -> tuple[View, LocalMap, Prior, Array]:
    """What the matcher is given in this trial, and the true pose."""
    rng, bearing = np.random.default_rng((seed, number)), bearings(case.beams, case.fov)
    T, T_new = place_both(case.scene, rng, case.off)
    local = mapped(case, T, bearing, rng)
    L = np.diag((case.prior[0] ** -2, case.prior[0] ** -2, case.prior[1] ** -2))
    return view_of(scan_at(case.scene, T_new, bearing, rng, case.sigma)), local, Prior(T, L), T_new


def place_both(scene: Scene, rng: np.random.Generator, off: tuple[float, float]) -> tuple[Array, Array]:
    """Two poses exactly ``off`` apart with room around both."""
    while True:
        T = scene.place(rng)
        a = rng.uniform(-np.pi, np.pi)
        turn = np.radians(off[1]) * rng.choice((-1.0, 1.0))
        T_new = se2.compose(T, np.array((off[0] * np.cos(a), off[0] * np.sin(a), turn)))
        if scene.clear(T_new, 0.2) and in_one_room(scene, T, T_new):
            return T, T_new


def in_one_room(scene: Scene, T: Array, T_new: Array) -> bool:
    """Whether nothing stands between two poses."""
    way = T_new[:2] - T[:2]
    length = float(np.hypot(way[0], way[1]))
    first = scene.ranges(np.array((T[0], T[1], 0.0)), np.array((np.arctan2(way[1], way[0]),)))
    return length == 0.0 or float(first[0]) > length


def mapped(case: Case, T: Array, bearing: Array, rng: np.random.Generator) -> LocalMap:
    """The local map of a scan from ``T`` and of others from about there, whose places are known."""
    local = local_map.empty(T[:2])
    for key in range(case.scans):
        at = T if key == 0 else place_near(case.scene, T, rng)
        scan = scan_at(case.scene, at, bearing, rng, case.sigma)
        lines = lines_of(points_of(scan, STILL, 80.0, 0.0))
        local = local_map.update(local, keep(key, at, at, scan, 0.0), lines, MapSettings(), case.sigma)
    return local


def place_near(scene: Scene, T: Array, rng: np.random.Generator) -> Array:
    """A place within half a metre and 0.4 rad, as keyframes lie to each other."""
    while True:
        away = np.array((*rng.uniform(-0.35, 0.35, 2), rng.uniform(-0.4, 0.4)))
        near = se2.compose(T, away)
        if scene.clear(near, 0.2) and in_one_room(scene, T, near):
            return near


def scan_at(scene: Scene, T: Array, bearing: Array, rng: np.random.Generator, sigma: float) -> Scan:
    """What a lidar at ``T`` measures."""
    distance = scene.ranges(T, bearing)
    seen = np.isfinite(distance)
    distance = np.where(seen, distance, 0.0) + np.where(seen, rng.normal(0.0, sigma, len(distance)), 0.0)
    return Scan(0.0, 0.0, 0, STILL, bearing, distance, np.where(seen, Beam.HIT, Beam.NONE).astype(np.uint8), sigma)


def view_of(scan: Scan) -> View:
    """The scan as it is matched."""
    beams = (scan.bearing_rad, scan.range_m, scan.beam)
    return View(oriented(points_of(scan, STILL, 80.0, 0.0), 100_000), STILL, beams, scan.sigma_m)
