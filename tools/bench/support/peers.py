"""Other matchers at their best settings, each in one thread: what ours is compared with in the same run.

All get the points of two scans and a start, and do everything from there: normals, index, iterations. Each comes in two
forms: as its documentation has it, and as we found it most accurate, at whatever cost.
"""

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import version

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

Array = npt.NDArray[np.float64]
Match = Callable[[Array, Array, Array], Array]
"""Reference points (n, 2), new points (m, 2), start (x, y, yaw): where the new scan was in the reference's frame."""

GATE = 0.5
"""Farthest partner, m: the same for all."""
STEP_M, STEP_RAD = 1e-4, 1e-5
"""A step shorter than this ends the iteration: a tenth of the accuracy that range noise allows."""
MOST = 50
NEIGHBOURS, MANY = 8, 20


def kdtree(neighbours: int) -> Match:
    """Point-to-line ICP on scipy's cKDTree, numpy throughout, Cauchy weights; normals from the scan's own order."""

    def match(reference: Array, points: Array, start: Array) -> Array:
        return iterate(cKDTree(reference), reference, normals(reference, neighbours), points, start)

    return match


def iterate(tree: cKDTree, reference: Array, normal: Array, points: Array, start: Array) -> Array:
    """The iterations of :func:`kdtree`."""
    x, y, yaw = start
    scale = GATE / 2
    for _ in range(MOST):
        c, s = np.cos(yaw), np.sin(yaw)
        u = points @ np.array(((c, s), (-s, c)))
        moved = u + np.array((x, y))
        distance, at = tree.query(moved, distance_upper_bound=GATE)
        ok = np.isfinite(distance)
        n, u, moved, at = normal[at[ok]], u[ok], moved[ok], at[ok]
        e = np.einsum("ij,ij->i", n, moved - reference[at])
        scale = max(0.025, min(scale, 2.0 * float(np.median(np.abs(e))) + 0.5 * scale))
        w = 1.0 / (1.0 + (e / scale) ** 2)
        J = np.column_stack((n, n[:, 1] * u[:, 0] - n[:, 0] * u[:, 1]))
        step = -np.linalg.solve((J.T * w) @ J, J.T @ (w * e))
        x, y, yaw = x + step[0], y + step[1], yaw + step[2]
        if np.hypot(step[0], step[1]) < STEP_M and abs(step[2]) < STEP_RAD and scale <= 0.03:
            break
        scale *= 0.7
    return np.array((x, y, yaw))


def normals(xy: Array, neighbours: int) -> Array:
    """Normals by principal components of each point's neighbours in the scan, vectorised."""
    n = len(xy)
    half = neighbours // 2
    window = np.clip(np.arange(n)[:, None] + np.arange(-half, half + 1), 0, n - 1)
    d = xy[window] - xy[:, None]
    d = np.where((np.hypot(d[..., 0], d[..., 1]) < 0.25)[..., None], d, 0.0)
    m = d.mean(axis=1)
    cxx = (d[..., 0] ** 2).mean(axis=1) - m[:, 0] ** 2
    cyy = (d[..., 1] ** 2).mean(axis=1) - m[:, 1] ** 2
    cxy = (d[..., 0] * d[..., 1]).mean(axis=1) - m[:, 0] * m[:, 1]
    angle = 0.5 * np.arctan2(2.0 * cxy, cxx - cyy)
    return np.column_stack((-np.sin(angle), np.cos(angle)))


def small_gicp(kind: str, neighbours: int) -> Match:
    """Koide's small_gicp. It is three-dimensional: without a second layer its normals would all point upwards.

    ``kind``: ``PLANE_ICP``, or ``GICP``, which takes distributions on both sides.
    """
    s = import_module("small_gicp")

    def match(reference: Array, points: Array, start: Array) -> Array:
        target, tree = s.preprocess_points(
            layers(reference), downsampling_resolution=1e-3, num_neighbors=2 * neighbours
        )
        source = s.PointCloud(flat(points))
        if kind == "GICP":
            source, _ = s.preprocess_points(layers(points), downsampling_resolution=1e-3, num_neighbors=2 * neighbours)
        found = s.align(
            target, source, tree, lift(start), registration_type=kind, max_correspondence_distance=GATE,
            num_threads=1, max_iterations=MOST, rotation_epsilon=STEP_RAD, translation_epsilon=STEP_M,
        )  # fmt: skip
        return drop(found.T_target_source)

    return match


def open3d(stages: tuple[tuple[float, float], ...], neighbours: int) -> Match:
    """Open3D's point-to-plane ICP with a robust kernel; normals handed to it, so it need not be lifted.

    ``stages``: one run after the other, each with its gate and the scale of its robust kernel, m.
    """
    o3d = import_module("open3d")
    registration = o3d.pipelines.registration
    stop = registration.ICPConvergenceCriteria(1e-7, 1e-7, MOST)
    kernel, loss = registration.TransformationEstimationPointToPlane, registration.CauchyLoss
    runs = [(gate, kernel(loss(scale))) for gate, scale in stages]

    def match(reference: Array, points: Array, start: Array) -> Array:
        target, source = o3d.geometry.PointCloud(), o3d.geometry.PointCloud()
        target.points, source.points = (
            o3d.utility.Vector3dVector(flat(reference)),
            o3d.utility.Vector3dVector(flat(points)),
        )
        target.normals = o3d.utility.Vector3dVector(flat(normals(reference, neighbours)))
        T = lift(start)
        for gate, how in runs:
            T = registration.registration_icp(source, target, gate, T, how, stop).transformation
        return drop(T)

    return match


def flat(xy: Array) -> Array:
    """(n, 3) with z = 0."""
    return np.column_stack((xy, np.zeros(len(xy))))


def layers(xy: Array) -> Array:
    """The points twice, 10 cm apart in height."""
    return np.concatenate((flat(xy), flat(xy) + np.array((0.0, 0.0, 0.1))))


def lift(T: Array) -> Array:
    """4 x 4 of a planar pose."""
    c, s = np.cos(T[2]), np.sin(T[2])
    return np.array(((c, -s, 0.0, T[0]), (s, c, 0.0, T[1]), (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)))


def drop(T: Array) -> Array:
    """Planar pose of a 4 x 4."""
    return np.array((T[0, 3], T[1, 3], np.arctan2(T[1, 0], T[0, 0])))


MAKERS: dict[str, tuple[float, Callable[[], tuple[Match, Match]]]] = {
    "scipy": (6.0, lambda: (kdtree(NEIGHBOURS), kdtree(MANY))),
    "small_gicp": (4.0, lambda: (small_gicp("PLANE_ICP", NEIGHBOURS), small_gicp("GICP", 2 * NEIGHBOURS))),
    "open3d": (2.0, lambda: (open3d(((GATE, 0.05),), NEIGHBOURS), open3d(((GATE, 0.1), (0.15, 0.025)), MANY))),
}
"""How many times faster than each ours has to be, and its two forms."""


def peers() -> dict[str, tuple[float, Match]]:
    """Those that are installed, by name, version and form; open3d (400 MB with what it needs) is in no lock file."""
    found = {}
    for package, (least, make) in MAKERS.items():
        try:
            usual, accurate = make()
        except ImportError as error:
            print(f"{package}: not compared, {error} (pip install {package})")
            continue
        name = f"{'cKDTree of ' if package == 'scipy' else ''}{package} {version(package)}"
        found[name] = (least, usual)
        found[f"{name}, for accuracy"] = (least, accurate)
    return found
