"""The Cramer-Rao bound of a scan's pose (Censi, ICRA 2007): what range noise lets anyone know, whatever the method."""

import numpy as np

from tools.bench.support.scenes import Array, Scene

GRAZING = 0.05
"""Least cosine of incidence that counts (87 deg): beyond it a real beam says nothing, and the formula almost all."""


def information(scene: Scene, T: Array, bearing: Array, sigma: float, also_from: Array | None = None) -> Array:
    """Fisher information (3, 3) of the pose of a lidar at ``T`` in known surroundings, world axes, base-centred.

    A beam of direction d that meets a surface of normal n at range r has dr/d(x, y) = -n / (n d) and
    dr/dyaw = -r (n d') / (n d), d' being d turned by 90 deg. With ``also_from`` only those beams count whose surface
    a lidar at that pose sees too: no other can be matched with what it saw.
    """
    r, normal = scene.surfaces(T, bearing)
    direction = np.column_stack((np.cos(bearing + T[2]), np.sin(bearing + T[2])))
    facing = np.abs((normal * direction).sum(axis=1))
    use = np.isfinite(r) & (facing > GRAZING)
    if also_from is not None:
        use &= seen_from(scene, also_from, T[:2] + np.where(use, r, 0.0)[:, None] * direction, bearing)
    n, d, cos, r = normal[use], direction[use], facing[use], r[use]
    sign = np.sign((n * d).sum(axis=1))
    across = sign * (n[:, 1] * d[:, 0] - n[:, 0] * d[:, 1])
    J = np.column_stack((sign[:, None] * n / cos[:, None], r * across / cos))
    return np.asarray(J.T @ J) / (sigma * sigma)


def seen_from(scene: Scene, T: Array, points: Array, bearing: Array) -> Array:
    """Which surface points (n, 2) a lidar at ``T`` with those bearings has in view."""
    away = points - T[:2]
    distance = np.hypot(away[:, 0], away[:, 1])
    angle = np.arctan2(away[:, 1], away[:, 0])
    relative = np.angle(np.exp(1j * (angle - T[2])))
    inside = (relative >= bearing[0]) & (relative <= bearing[-1])
    first = scene.ranges(np.array((T[0], T[1], 0.0)), angle)
    return np.asarray(inside & (first > distance - 0.01))


def bound(scene: Scene, T: Array, T_new: Array, bearing: Array, sigma: float, scans: float) -> Array:
    """Least covariance (3, 3) of a match at ``T_new`` with ``scans`` scans from about ``T``: (1 + 1 / scans) / I."""
    return (1.0 + 1.0 / scans) * np.linalg.inv(information(scene, T_new, bearing, sigma, T) + 1e-6 * np.eye(3))
