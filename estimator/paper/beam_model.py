"""The beam sensor model (Eq. 8-9): probability of a scan at a pose, given the surfaces of the map.

Each measured range is one of four things. It is the expected surface: a Gaussian cut off at the sensor's limits. Or it
is an obstacle before it: an exponential up to the surface. Or there is no echo (a discrete probability), or any range.
Eq. 9 multiplies the beams as if they were independent. They are not: a bent wall or a wrong heading shifts hundreds of
them together. So the product is tempered, ``p^(1/c)`` with one in ``c`` beams independent. ``c`` = number of beams
gives the mean per measurement that Eq. 15 needs.

Expected ranges come from ray casting, not from a likelihood field of distances to the nearest point. Such a field
ignores occlusion, and would rate a scan that sees through a wall as good. Casting the surfaces as segments (a z-buffer
over bearings) costs as much as one pass over the points.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator.measurements import Beams
from estimator.numerics.arrays import Array
from estimator.numerics.jit import kernel

ROOT_2PI = math.sqrt(2.0 * math.pi)
GAP_M, GAP_SHARE = 0.15, 0.08
"""Largest gap (m) between neighbouring points of one surface, and the additional limit as a share of their range."""

EDGE_ON = 1e-12
"""Sine below which a segment is seen edge on, or is a point; rounding then decides which end is nearer."""

HIT, SHORT, MAX, RAND, SIGMA, DECAY, FAR = range(7)
"""Columns of a model's row."""


@dataclass(frozen=True, slots=True)
class BeamModel:
    """Mixture weights (any positive scale, normalised in :meth:`row`) and shapes of Eq. 9.

    Attributes:
        hit, short, most, rand: weights of the surface, an obstacle before it, no echo, any range.
        sigma_m: sigma of the hit, range noise of both the scan and the surface.
        decay: decay of the short ones, 1/m.
        far_m: longest range.
    """

    hit: float = 0.80
    short: float = 0.08
    most: float = 0.04
    rand: float = 0.08
    sigma_m: float = 0.03
    decay: float = 0.5
    far_m: float = 30.0

    def row(self) -> Array:
        """The model as an array for the kernels; the weights sum to one.

        Raises:
            ValueError: a weight is negative, all are zero, or a shape is not positive.
        """
        weights = np.array((self.hit, self.short, self.most, self.rand))
        shapes = np.array((self.sigma_m, self.decay, self.far_m))
        if not (np.all(weights >= 0.0) and weights.sum() > 0.0 and np.all(shapes > 0.0) and np.isfinite(shapes).all()):
            raise ValueError(f"beam model: weights {weights} must not be negative, shapes {shapes} must be positive")
        return np.concatenate((weights / weights.sum(), shapes))


@kernel("f8(f8, f8, f8[::1])", inner=True)
def density(z: float, expected: float, model: Array) -> float:
    """Probability density (1/m) of an echo from range ``z`` where a surface is expected at ``expected``.

    Together with :func:`silence` it sums to one over all results of a beam. A surface beyond the longest range gives no
    echo.
    """
    far = model[FAR]
    if not 0.0 <= z <= far:
        return 0.0
    p: float = model[RAND] / far
    if z <= expected:
        p += model[SHORT] * model[DECAY] * np.exp(-model[DECAY] * z) / -np.expm1(-model[DECAY] * min(expected, far))
    if expected < far:
        sigma = model[SIGMA]
        k = 1.0 / (sigma * math.sqrt(2.0))
        inside = 0.5 * (math.erf(k * (far - expected)) + math.erf(k * expected))
        u = (z - expected) / sigma
        p += model[HIT] * np.exp(-0.5 * u * u) / (ROOT_2PI * sigma * inside)
    return p


@kernel("f8(f8, f8[::1])", inner=True)
def silence(expected: float, model: Array) -> float:
    """Probability that a beam returns no echo."""
    return float(model[MAX] if expected < model[FAR] else model[MAX] + model[HIT])


@kernel("Tuple((f8, i8))(Tuple((f8[::1], f8[::1], u1[::1])), f8[::1], f8[::1], i8)")
def sum_log(
    beams: tuple[Array, Array, npt.NDArray[np.uint8]], expected: Array, model: Array, stride: int
) -> tuple[float, int]:
    """Logarithm of Eq. 9 over every ``stride``-th usable beam where a surface is expected; and their number.

    A range is not usable if it is not finite, not positive or beyond the longest. A beam without an expected surface is
    not usable either.
    """
    _, distance, kind = beams
    total, count = 0.0, 0
    for k in range(0, len(distance), stride):
        z = expected[k]
        if not z > 0.0 or z == np.inf:
            continue
        if kind[k] == 1:
            if not 0.0 < distance[k] <= model[FAR]:
                continue
            total += np.log(max(density(distance[k], z, model), 1e-300))
        elif kind[k] == 2 and distance[k] > z:
            total += np.log(max(silence(z, model), 1e-300))
        else:
            continue
        count += 1
    return total, count


@kernel("void(f8[:, ::1], f8[::1], f8[::1], f8[::1])")
def cast(segments: Array, eye: Array, bearing: Array, expected: Array) -> None:
    """Write the range of the nearest segment (n, 4: x0, y0, x1, y1) on each evenly spaced bearing; inf where none.

    ``eye``: pose of the lidar. A segment fills the beams between the bearings of its ends. The cost is the sum of
    segments and beams, not their product.
    """
    expected[:] = np.inf
    n = len(bearing)
    if n < 2 or bearing[n - 1] == bearing[0]:
        return
    step = (bearing[n - 1] - bearing[0]) / (n - 1)
    turn = 2.0 * np.pi / abs(step)
    c, s = np.cos(eye[2] + bearing[0]), np.sin(eye[2] + bearing[0])
    for i in range(len(segments)):
        ax, ay = segments[i, 0] - eye[0], segments[i, 1] - eye[1]
        bx, by = segments[i, 2] - eye[0], segments[i, 3] - eye[1]
        ax, ay, bx, by = c * ax + s * ay, c * ay - s * ax, c * bx + s * by, c * by - s * bx
        cross, dot = ax * by - ay * bx, ax * bx + ay * by
        if abs(cross) <= EDGE_ON * (ax * ax + ay * ay + bx * bx + by * by):
            continue
        first, span = np.arctan2(ay, ax) / step, np.arctan2(cross, dot) / step
        low, high = min(first, first + span), max(first, first + span)
        lap = np.floor(low / turn) * turn  # the bearing's first beam is at 0, others up to n - 1
        for shift in (lap, lap + turn):
            for k in range(max(0, int(np.ceil(low - shift))), min(n - 1, int(np.floor(high - shift))) + 1):
                u, v = np.cos(k * step), np.sin(k * step)
                across = u * (by - ay) - v * (bx - ax)
                if across != 0.0:
                    r = cross / across
                    if 0.0 < r < expected[k]:
                        expected[k] = r


def segments_of(xy: Array) -> Array:
    """Surfaces (n, 4) between neighbouring points (m, 2) of a scan, seen from the origin."""
    if len(xy) < 2:
        return np.empty((0, 4))
    apart = np.hypot(*(xy[1:] - xy[:-1]).T)
    near = apart < np.maximum(GAP_M, GAP_SHARE * np.hypot(*xy[1:].T))
    return np.ascontiguousarray(np.column_stack((xy[:-1], xy[1:]))[near])


def log_likelihood(segments: Array, T_ref_lidar: Array, beams: Beams, model: BeamModel, tempering: float) -> float:
    """``ln p^(1/c)`` of Eq. 9 for a scan at a pose among surfaces; 0 without a usable beam.

    Args:
        segments: (n, 4) in the reference frame.
        T_ref_lidar: pose of the lidar there.
        beams: evenly spaced bearings, ranges, kinds.
        model: see :class:`BeamModel`.
        tempering: c, beams per independent one, at least 1.

    Raises:
        ValueError: ``tempering`` below 1, which would sharpen instead.
    """
    if not tempering >= 1.0:
        raise ValueError(f"tempering {tempering} is below 1: beams are not more than independent")
    return _sum(segments, T_ref_lidar, beams, model)[0] / tempering


def mean_log(segments: Array, T_ref_lidar: Array, beams: Beams, model: BeamModel) -> float:
    """``ln rho p`` of Eq. 9 as a mean per beam; ``rho`` makes it 0 where all beams hit as expected. -inf without beams.

    That is the tempering that Eq. 15 needs: all beams together weigh as much as one.
    """
    total, count, row = _sum(segments, T_ref_lidar, beams, model)
    return total / count - math.log(row[HIT] / (ROOT_2PI * row[SIGMA])) if count else -math.inf


def quality(segments: Array, T_ref_lidar: Array, beams: Beams, model: BeamModel) -> float:
    """Mean gain of a beam's log-likelihood over an uninformed pose, in nats a beam; NaN without usable beams.

    Above 0 the surfaces support the pose. At an uninformed pose every range up to the longest is equally likely.
    """
    total, count, row = _sum(segments, T_ref_lidar, beams, model)
    return total / count + math.log(row[FAR]) if count else math.nan


def _sum(segments: Array, eye: Array, beams: Beams, model: BeamModel) -> tuple[float, int, Array]:
    """Logarithm of Eq. 9, the number of usable beams, and the model's row."""
    expected, row = np.empty(len(beams[0])), model.row()
    cast(segments, eye, beams[0], expected)
    total, count = sum_log(beams, expected, row, 1)
    return total, count, row
