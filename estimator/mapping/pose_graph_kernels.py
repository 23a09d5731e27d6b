"""Kernels of the pose graph: residuals, robust costs, normal equations, descent and marginal covariance.

The step of Gauss-Newton is taken in relative coordinates along a spanning tree.
The normal equations give a small displacement of each pose in the map's axes. Added to the poses, it distorts a long
chain that rotates by much: one rotation moves far poses along a straight line instead of a circle. Here the step
changes each pose relative to its parent in the tree. Then the edges of the tree get exactly the error that the
equations predict. Only loops are affected by the curvature (cf. Olson, Leonard, Teller, ICRA 2006; Grisetti et al., RSS
2007, who optimise in such coordinates altogether).
"""

from __future__ import annotations

import numpy as np

from estimator.numerics.arrays import Array, Bools, Ints
from estimator.numerics.block_ldl import factor, solve
from estimator.numerics.elimination_ordering import NONE, adjacency
from estimator.numerics.jit import kernel

NARROWER = 0.5
"""Factor on the robust scale per step."""


@kernel("Tuple((i8[::1], i8[::1]))(i8, i8[:, ::1], b1[::1], b1[::1])", aside=True)
def spanning(n: int, edges: Ints, doubtful: Bools, free: Bools) -> tuple[Ints, Ints]:
    """Spanning tree over the edges that are not doubtful: poses by distance from its roots, and the parent of each.

    Poses that are not free are roots. So is the first pose of each component without one; a root's parent is ``NONE``.
    """
    sure = np.empty((len(edges), 2), np.int64)
    count = 0
    for k in range(len(edges)):
        if not doubtful[k]:
            sure[count] = edges[k]
            count += 1
    first, near = adjacency(n, sure[:count])
    order, parent, reached = np.empty(n, np.int64), np.full(n, NONE), ~free
    end = 0
    for i in range(n):
        if reached[i]:
            order[end] = i
            end += 1
    at = 0
    for root in range(n + 1):
        while at < end:
            i = order[at]
            at += 1
            for m in range(first[i], first[i + 1]):
                j = near[m]
                if not reached[j]:
                    reached[j], parent[j] = True, i
                    order[end] = j
                    end += 1
        if root < n and not reached[root]:
            reached[root] = True
            order[end] = root
            end += 1
    return order, parent


@kernel("void(f8[:, ::1], f8[:, ::1], i8[::1], Tuple((i8[::1], i8[::1])), f8[:, ::1])", inner=True)
def carry_on(poses: Array, step: Array, place: Ints, tree: tuple[Ints, Ints], out: Array) -> None:
    """Write ``poses`` after ``step`` to ``out`` (n, 3); ``step`` is indexed by ``place``, negative for a held pose."""
    order, parent = tree
    for at in range(len(order)):
        j = order[at]
        i, row = parent[j], place[j]
        dx = dy = turn = 0.0
        if row >= 0:
            dx, dy, turn = step[row, 0], step[row, 1], step[row, 2]
        if i < 0:  # a root moves along an arc
            half = 0.5 * turn
            chord = np.sin(half) / half if abs(half) > 1e-8 else 1.0
            c, s = chord * np.cos(half), chord * np.sin(half)
            out[j, 0] = poses[j, 0] + c * dx - s * dy
            out[j, 1] = poses[j, 1] + s * dx + c * dy
            out[j, 2] = poses[j, 2] + turn
            continue
        before = 0.0
        if place[i] >= 0:
            before = step[place[i], 2]
            dx -= step[place[i], 0]
            dy -= step[place[i], 1]
        x, y = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        dx += before * y
        dy -= before * x
        change = out[i, 2] - poses[i, 2]
        c, s = np.cos(change), np.sin(change)
        out[j, 0] = out[i, 0] + c * (x + dx) - s * (y + dy)
        out[j, 1] = out[i, 1] + s * (x + dx) + c * (y + dy)
        out[j, 2] = out[i, 2] + poses[j, 2] - poses[i, 2] + turn - before


@kernel("i8[::1](i8, i8[:, ::1])", aside=True)
def parts_of(n: int, edges: Ints) -> Ints:
    """For each pose the lowest number in its connected component."""
    root = np.arange(n)
    for k in range(len(edges)):
        a, b = edges[k, 0], edges[k, 1]
        while root[a] != a:
            root[a] = root[root[a]]
            a = root[a]
        while root[b] != b:
            root[b] = root[root[b]]
            b = root[b]
        if a < b:
            root[b] = a
        else:
            root[a] = b
    for i in range(n):
        a = i
        while root[a] != a:
            a = root[a]
        root[i] = a
    return root


@kernel("f8(f8)", inner=True)
def wrapped(angle: float) -> float:
    """Angle (rad) wrapped to (-pi, pi]."""
    return float(angle - 2.0 * np.pi * np.ceil((angle - np.pi) / (2.0 * np.pi)))


@kernel("f8(f8[:], f8[::1], f8[::1])", inner=True)
def quadratic(H: Array, e: Array, out: Array) -> float:
    """``e^T H e`` of an upper triangle; ``out`` = H e."""
    out[0] = H[0] * e[0] + H[1] * e[1] + H[2] * e[2]
    out[1] = H[1] * e[0] + H[3] * e[1] + H[4] * e[2]
    out[2] = H[2] * e[0] + H[4] * e[1] + H[5] * e[2]
    return float(e[0] * out[0] + e[1] * out[1] + e[2] * out[2])


@kernel("f8(f8, f8)", inner=True)
def believed(chi2: float, phi: float) -> float:
    """Weight of a doubtful edge: the derivative of :func:`potential`."""
    s = phi / (phi + chi2)
    return s * s


@kernel("f8(f8, f8)", inner=True)
def potential(chi2: float, phi: float) -> float:
    """Geman-McClure's cost, which saturates at ``phi``."""
    return phi * chi2 / (phi + chi2)


@kernel("void(f8[:, ::1], i8, i8, f8[:], f8[::1])", inner=True)
def edge_error(poses: Array, i: int, j: int, z: Array, e: Array) -> None:
    """Write ``T_z^-1 (T_i^-1 T_j)`` to ``e``; with i = -1, T_i is the origin."""
    x = y = yaw = 0.0
    if i >= 0:
        x, y, yaw = poses[i, 0], poses[i, 1], poses[i, 2]
    c, s = np.cos(yaw), np.sin(yaw)
    dx, dy = poses[j, 0] - x, poses[j, 1] - y
    u, v = c * dx + s * dy - z[0], c * dy - s * dx - z[1]
    c, s = np.cos(z[2]), np.sin(z[2])
    e[0], e[1], e[2] = c * u + s * v, c * v - s * u, wrapped(poses[j, 2] - yaw - z[2])


Given = tuple[Ints, Array, Array, Bools]


Absolute = tuple[Ints, Array, Array]


GIVEN = "Tuple((i8[:, ::1], f8[:, ::1], f8[:, ::1], b1[::1]))"


ABSOLUTE = "Tuple((i8[::1], f8[:, ::1], f8[:, ::1]))"


PATTERN = "Tuple((i8[::1], i8[::1], i8[::1], i8[::1]))"


@kernel(f"f8(f8[:, ::1], {GIVEN}, {ABSOLUTE}, f8[::1], f8)", inner=True)
def cost(poses: Array, given: Given, absolute: Absolute, trust: Array, phi: float) -> float:
    """chi2 as weighted; writes the weight of each edge to ``trust``.

    A doubtful edge counts by its potential, so that the descent can use it as its cost.
    """
    edges, between, information, doubtful = given
    total = 0.0
    e, He = np.empty(3), np.empty(3)
    for k in range(len(edges)):
        edge_error(poses, edges[k, 0], edges[k, 1], between[k], e)
        chi2 = quadratic(information[k], e, He)
        trust[k] = believed(chi2, phi) if doubtful[k] else 1.0
        total += potential(chi2, phi) if doubtful[k] else chi2
    for k in range(len(absolute[0])):
        edge_error(poses, -1, absolute[0][k], absolute[1][k], e)
        total += potential(quadratic(absolute[2][k], e, He), phi)
    return total


@kernel(f"f8(f8[:, ::1], {GIVEN}, {ABSOLUTE})", aside=True)
def worst(poses: Array, given: Given, absolute: Absolute) -> float:
    """Largest chi2 of an edge or prior that may be false."""
    edges, between, information, doubtful = given
    e, He = np.empty(3), np.empty(3)
    largest = 0.0
    for k in range(len(edges)):
        if doubtful[k]:
            edge_error(poses, edges[k, 0], edges[k, 1], between[k], e)
            largest = max(largest, quadratic(information[k], e, He))
    for k in range(len(absolute[0])):
        edge_error(poses, -1, absolute[0][k], absolute[1][k], e)
        largest = max(largest, quadratic(absolute[2][k], e, He))
    return largest


@kernel("void(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[:, ::1])", inner=True)
def add_product(A: Array, H: Array, B: Array, out: Array) -> None:
    """``out += A^T H B`` of 3 x 3."""
    for r in range(3):
        p = A[0, r] * H[0, 0] + A[1, r] * H[1, 0] + A[2, r] * H[2, 0]
        q = A[0, r] * H[0, 1] + A[1, r] * H[1, 1] + A[2, r] * H[2, 1]
        t = A[0, r] * H[0, 2] + A[1, r] * H[1, 2] + A[2, r] * H[2, 2]
        for c in range(3):
            out[r, c] += p * B[0, c] + q * B[1, c] + t * B[2, c]


@kernel("void(f8[:, ::1], f8[::1], f8[::1])", inner=True)
def subtract(A: Array, v: Array, out: Array) -> None:
    """``out -= A^T v``."""
    for r in range(3):
        out[r] -= A[0, r] * v[0] + A[1, r] * v[1] + A[2, r] * v[2]


@kernel(f"void(f8[:, ::1], {GIVEN}, {ABSOLUTE}, Tuple((i8[::1], {PATTERN})), Tuple((f8[::1], i8[::1], f8)),"
        " Tuple((f8[:, :, ::1], f8[:, :, ::1], f8[:, ::1])))", inner=True)  # fmt: skip
def linearise(
    poses: Array,
    given: Given,
    absolute: Absolute,
    structure: tuple[Ints, tuple[Ints, Ints, Ints, Ints]],
    how: tuple[Array, Ints, float],
    system: tuple[Array, Array, Array],
) -> None:
    """Normal equations in the order of elimination. ``how``: weights, block of each edge, phi."""
    edges, between, information, _ = given
    place, _ = structure
    trust, slot, phi = how
    diagonal, below, b = system
    diagonal[:], below[:], b[:] = 0.0, 0.0, 0.0
    e, He = np.empty(3), np.empty(3)
    H, A, B = np.empty((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    count = len(edges)
    for k in range(count + len(absolute[0])):
        if k < count:
            i, j, z, w = edges[k, 0], edges[k, 1], between[k], information[k]
        else:
            i, j, z, w = -1, absolute[0][k - count], absolute[1][k - count], absolute[2][k - count]
        edge_error(poses, i, j, z, e)
        chi2 = quadratic(w, e, He)
        scale = trust[k] if k < count else believed(chi2, phi)
        H[0, 0], H[0, 1], H[0, 2], H[1, 1], H[1, 2], H[2, 2] = w[0], w[1], w[2], w[3], w[4], w[5]
        H[1, 0], H[2, 0], H[2, 1] = w[1], w[2], w[4]
        H *= scale
        He *= scale
        yaw = z[2] + (poses[i, 2] if i >= 0 else 0.0)
        c, s = np.cos(yaw), np.sin(yaw)
        B[0, 0], B[0, 1], B[1, 0], B[1, 1], B[2, 2] = c, s, -s, c, 1.0
        pj = place[j]
        pi = place[i] if i >= 0 else -1
        if pj >= 0:
            add_product(B, H, B, diagonal[pj])
            subtract(B, He, b[pj])
        if pi < 0:
            continue
        dx, dy = poses[j, 0] - poses[i, 0], poses[j, 1] - poses[i, 1]
        A[0, 0], A[0, 1], A[1, 0], A[1, 1], A[2, 2] = -c, -s, s, -c, -1.0
        A[0, 2], A[1, 2] = c * dy - s * dx, -c * dx - s * dy
        add_product(A, H, A, diagonal[pi])
        subtract(A, He, b[pi])
        if pj >= 0:
            if pj > pi:
                add_product(B, H, A, below[slot[k]])
            else:
                add_product(A, H, B, below[slot[k]])


@kernel(f"i8[::1](i8[:, ::1], i8[::1], {PATTERN})", inner=True)
def slots_of(edges: Ints, place: Ints, pattern: tuple[Ints, Ints, Ints, Ints]) -> Ints:
    """Index of each edge's block in the pattern, -1 where one of its poses is held."""
    start, down, _, _ = pattern
    slot = np.full(len(edges), -1)
    for k in range(len(edges)):
        i, j = place[edges[k, 0]], place[edges[k, 1]]
        if i < 0 or j < 0:
            continue
        column, row = min(i, j), max(i, j)
        low, high = start[column], start[column + 1]
        while low < high:
            middle = (low + high) >> 1
            if down[middle] < row:
                low = middle + 1
            else:
                high = middle
        slot[k] = low
    return slot


@kernel(
    f"Tuple((f8, i8, b1))(f8[:, ::1], {GIVEN}, {ABSOLUTE}, Tuple((i8[::1], {PATTERN})), f8[::1], f8[::1])", aside=True
)
def descend(
    poses: Array,
    given: Given,
    absolute: Absolute,
    structure: tuple[Ints, tuple[Ints, Ints, Ints, Ints]],
    trust: Array,
    told: Array,
) -> tuple[float, int, bool]:
    """Gauss-Newton steps, damped where they do not descend; changes ``poses``.

    Each step is tried as it is and along the spanning tree; the one with the lower cost counts. ``told``: iteration
    cap, convergence threshold, phi, and the initial scale. Returns the cost, the iterations and whether it has
    converged.
    """
    place, pattern = structure
    n, nnz = len(pattern[0]) - 1, len(pattern[1])
    phi = told[2]
    slot = slots_of(given[0], place, pattern)
    diagonal, below, b = np.empty((n, 3, 3)), np.empty((nnz, 3, 3)), np.empty((n, 3))
    inverse = np.empty((n, 3, 3))
    tree = spanning(len(poses), given[0], given[3], place >= 0)
    alone = np.arange(len(poses)), np.full(len(poses), NONE)
    other = poses.copy()
    scale = max(phi, told[3])
    best = cost(poses, given, absolute, trust, scale)
    trial, count, damping, done = poses.copy(), 0, 0.0, False
    while count < told[0] and not done:
        count += 1
        linearise(poses, given, absolute, structure, (trust, slot, scale), (diagonal, below, b))
        for i in range(n):
            for r in range(3):
                diagonal[i, r, r] *= 1.0 + damping
        now = np.inf
        if factor(pattern, (diagonal, below), inverse) < 0:
            solve(pattern, below, inverse, b)
            now = np.inf
            for way in (alone, tree):
                carry_on(poses, b, place, way, other)
                then = cost(other, given, absolute, trust, scale)
                if then < now:
                    now = then
                    trial, other = other, trial
        small = abs(best - now) <= told[1] * best
        if now <= best:
            poses[:] = trial
            best = now
            damping = 0.0 if damping < 1e-4 else 0.1 * damping
        elif not small:
            damping = max(1e-4, 10.0 * damping)
        if scale > phi and (now <= best or small):
            scale = max(phi, NARROWER * scale)
            small = False
        best = cost(poses, given, absolute, trust, scale)
        done = small or damping > 1e6
    for i in range(len(poses)):
        poses[i, 2] = wrapped(poses[i, 2])
    return best, count, done and damping <= 1e6


@kernel(
    f"b1(f8[:, ::1], {GIVEN}, {ABSOLUTE}, Tuple((i8[::1], {PATTERN})), Tuple((f8[::1], f8, i8)), f8[:, ::1])",
    aside=True,
)
def marginal(
    poses: Array,
    given: Given,
    absolute: Absolute,
    structure: tuple[Ints, tuple[Ints, Ints, Ints, Ints]],
    asked: tuple[Array, float, int],
    covariance: Array,
) -> bool:
    """Covariance of one pose: its block of the inverse, column by column. ``asked``: weights, phi, index of the pose.

    False where the normal equations are singular.
    """
    trust, phi, which = asked
    place, pattern = structure
    n, nnz = len(pattern[0]) - 1, len(pattern[1])
    diagonal, below, b = np.empty((n, 3, 3)), np.empty((nnz, 3, 3)), np.empty((n, 3))
    inverse = np.empty((n, 3, 3))
    linearise(poses, given, absolute, structure, (trust, slots_of(given[0], place, pattern), phi), (diagonal, below, b))
    if factor(pattern, (diagonal, below), inverse) >= 0:
        return False
    for c in range(3):
        b[:] = 0.0
        b[which, c] = 1.0
        solve(pattern, below, inverse, b)
        for r in range(3):
            covariance[r, c] = b[which, r]
    return True
