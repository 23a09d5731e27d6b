"""SE(2): planar rigid transforms as float64 arrays ``(x, y, yaw)``; ``T_a_b`` maps b coordinates into a (m, m, rad)."""

from __future__ import annotations

import math

import numpy as np

from estimator.numerics.arrays import Array


def identity() -> Array:
    """The identity transform."""
    return np.zeros(3)


def wrap(angle: float) -> float:
    """The angle wrapped into [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


def compose(T_a_b: Array, T_b_c: Array) -> Array:
    """``T_a_c = T_a_b T_b_c``, with yaw wrapped."""
    x, y, yaw = T_a_b.tolist()
    u, v, w = T_b_c.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array((x + c * u - s * v, y + s * u + c * v, wrap(yaw + w)))


def compose_all(T_a_b: Array, T_b_c: Array) -> Array:
    """:func:`compose` with each row of ``T_b_c`` (n, 3); returns (n, 3)."""
    c, s = math.cos(T_a_b[2]), math.sin(T_a_b[2])
    u, v, yaw = T_b_c.T
    turned = (T_a_b[2] + yaw + math.pi) % (2.0 * math.pi) - math.pi
    return np.column_stack((T_a_b[0] + c * u - s * v, T_a_b[1] + s * u + c * v, turned))


def inverse(T_a_b: Array) -> Array:
    """``T_b_a``."""
    x, y, yaw = T_a_b.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array((-c * x - s * y, s * x - c * y, wrap(-yaw)))


def between(T_a_b: Array, T_a_c: Array) -> Array:
    """``T_b_c``: pose of c relative to b."""
    x, y, yaw = T_a_b.tolist()
    u, v, w = T_a_c.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    u, v = u - x, v - y
    return np.array((c * u + s * v, c * v - s * u, wrap(w - yaw)))


def log(T: Array) -> Array:
    """Logarithm map: constant body twist that produces this motion in unit time."""
    x, y, yaw = T.tolist()
    half = 0.5 * yaw
    k = 1.0 - half * half / 3.0 if abs(yaw) < 1e-4 else half / math.tan(half)
    return np.array((k * x + half * y, k * y - half * x, yaw))


def exp(twist: Array) -> Array:
    """Exponential map: motion after unit time at this constant body twist; the inverse of :func:`log`."""
    u, v, w = twist.tolist()
    if abs(w) < 1e-4:
        s, c = 1.0 - w * w / 6.0, 0.5 * w
    else:
        s, c = math.sin(w) / w, (1.0 - math.cos(w)) / w
    return np.array((s * u - c * v, c * u + s * v, wrap(w)))


def apply(T_a_b: Array, points_b: Array) -> Array:
    """Points (n, 2) mapped from b into a."""
    x, y, yaw = T_a_b.tolist()
    c, s = math.cos(yaw), math.sin(yaw)
    return np.asarray(points_b @ np.array(((c, s), (-s, c))) + np.array((x, y)))


def rotation(yaw: float) -> Array:
    """3x3 matrix that rotates (x, y) by ``yaw`` and keeps the yaw component."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))


def carry(T_a_b: Array, T_b_c: Array, P_b: Array) -> Array:
    """Covariance of ``T_a_c`` from ``P_b``, that of ``T_a_b`` (3x3, axes of a).

    A heading error of b moves c along the lever arm.
    """
    x, y, _ = (compose(T_a_b, T_b_c) - T_a_b).tolist()
    F = np.array(((1.0, 0.0, -y), (0.0, 1.0, x), (0.0, 0.0, 1.0)))
    return np.asarray(F @ P_b @ F.T)


def adjoint(T: Array) -> Array:
    """Adjoint matrix (3x3) of ``T``: ``T Exp(d) = Exp(Ad d) T``, a small motion expressed in the frame before ``T``."""
    A = rotation(float(T[2]))
    A[0, 2], A[1, 2] = T[1], -T[0]
    return A


def fraction(T: Array, share: float) -> Array:
    """Motion over a share (0 to 1) of the time of ``T``, at constant twist."""
    return exp(log(T) * share)


def lever_matrix(lever: Array) -> Array:
    """Jacobian (3, 3) of a pose error at the far end of a lever (x, y), m: a heading error moves that end."""
    return np.array(((1.0, 0.0, -lever[1]), (0.0, 1.0, lever[0]), (0.0, 0.0, 1.0)))
