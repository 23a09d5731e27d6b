"""Ray casting kernels: what light of one scan meets, with glass, mirrors, floor and the finite width of a beam.

All kernels of the simulator are in this one file, because the compiler's cache does not notice an edited callee in
another file. Everything random is drawn outside and handed in.

Energies are relative to a white wall met squarely at 1 m: a matt surface of albedo ``rho`` under incidence ``theta`` at
range ``r`` returns ``rho cos(theta) / r^2``.
"""

from __future__ import annotations

from math import cos, exp, fabs, inf, sin, sqrt
from typing import Any, Final

import numpy as np

from estimator.numerics.jit import kernel

BRANCHES: Final = 8  # glass and mirrors followed per sub-ray
ECHOES_PER_BEAM: Final = 48
SUB_RAYS: Final = 3
SUB_OFFSET: Final = (-1.0, 0.0, 1.0)  # in units of the half divergence
SUB_WEIGHT: Final = (0.25, 0.5, 0.25)
MIN_GAIN: Final = 1e-3  # branches weaker than this are not followed
GLINT_WIDTH: Final = 0.035  # rad: how far off its normal a mirror still looks back at the sensor
GLINT_GAIN: Final = 6.0
FLOOR_ALBEDO: Final = 0.30
FLOOR_MIRROR: Final = 0.04

WORLD: Final = "Tuple((f8[:,::1], i4[::1], f8[::1], f8[:,::1], f8[:,::1]))"
"""cell_shapes, cell_start, frame, material table, polished floors: see :class:`tools.sim.building.world.World`.

Taken apart only where that happens once per ray or less: numba counts a reference for every part it takes.
"""

WORK: Final = "Tuple((f8[:,::1], f8[::1], f8[::1], f8[:,::1]))"
"""Scratch, so that nothing is allocated per ray: branches, hit, surface, echoes (last row: their count)."""


@kernel("f8(f8[::1], f8[:,::1], i8)")
def meet_segment(ray: Any, shapes: Any, n: Any) -> Any:
    """Distance along ``ray`` (ox, oy, dx, dy, ..) to the segment in row ``n``, inf if it is missed."""
    ex, ey = shapes[n, 3] - shapes[n, 1], shapes[n, 4] - shapes[n, 2]
    cross = ray[2] * ey - ray[3] * ex
    if fabs(cross) < 1e-15:
        return inf
    wx, wy = shapes[n, 1] - ray[0], shapes[n, 2] - ray[1]
    t = (wx * ey - wy * ex) / cross
    u = (wx * ray[3] - wy * ray[2]) / cross
    if t > 0.0 and 0.0 <= u <= 1.0:
        return t
    return inf


@kernel("f8(f8[::1], f8, f8, f8)")
def meet_circle(ray: Any, cx: Any, cy: Any, radius: Any) -> Any:
    """Distance along ``ray`` to the outside of a circle, inf if it is missed or the ray starts inside."""
    wx, wy = cx - ray[0], cy - ray[1]
    along = wx * ray[2] + wy * ray[3]
    gap = wx * wx + wy * wy - radius * radius
    below = along * along - gap
    if along <= 0.0 or gap < 0.0 or below < 0.0:
        return inf
    return along - sqrt(below)


@kernel("void(f8[::1], f8[:,::1], i8, f8[::1])")
def note_normal(ray: Any, shapes: Any, n: Any, hit: Any) -> None:
    """Complete a hit at distance ``hit[0]`` on row ``n``: unit normal and material."""
    if shapes[n, 0] == 0.0:
        nx, ny = shapes[n, 4] - shapes[n, 2], shapes[n, 1] - shapes[n, 3]
    else:
        nx = ray[0] + hit[0] * ray[2] - shapes[n, 1]
        ny = ray[1] + hit[0] * ray[3] - shapes[n, 2]
    norm = sqrt(nx * nx + ny * ny)
    hit[1] = nx / norm
    hit[2] = ny / norm
    hit[3] = shapes[n, 5]


@kernel("void(f8[::1], f8[:,::1], i4[::1], f8[::1], f8[::1])")
def meet_static(ray: Any, shapes: Any, start: Any, frame: Any, hit: Any) -> None:
    """Nearest standing surface by walking the cells along the ray (Amanatides and Woo, 1987)."""
    cell = frame[2]
    nx, ny = int(frame[3]), int(frame[4])
    ix, iy = int((ray[0] - frame[0]) / cell), int((ray[1] - frame[1]) / cell)
    step_x, step_y = (1 if ray[2] > 0 else -1), (1 if ray[3] > 0 else -1)
    delta_x, delta_y, next_x, next_y = inf, inf, inf, inf
    if fabs(ray[2]) > 1e-12:
        delta_x, next_x = cell / fabs(ray[2]), (frame[0] + (ix + (step_x > 0)) * cell - ray[0]) / ray[2]
    if fabs(ray[3]) > 1e-12:
        delta_y, next_y = cell / fabs(ray[3]), (frame[1] + (iy + (step_y > 0)) * cell - ray[1]) / ray[3]
    best, nearest = hit[0], -1
    while 0 <= ix < nx and 0 <= iy < ny:
        flat = iy * nx + ix
        for n in range(start[flat], start[flat + 1]):
            if shapes[n, 0] == 0.0:
                distance = meet_segment(ray, shapes, n)
            else:
                distance = meet_circle(ray, shapes[n, 1], shapes[n, 2], shapes[n, 3])
            if distance < best:
                best, nearest = distance, n
        leave = min(next_x, next_y)
        if best <= leave or leave > ray[4]:
            break
        if next_x < next_y:
            ix += step_x
            next_x += delta_x
        else:
            iy += step_y
            next_y += delta_y
    if nearest >= 0:
        hit[0] = best
        note_normal(ray, shapes, nearest, hit)


@kernel("void(f8[::1], f8[:,::1], f8[::1])")
def meet_movers(ray: Any, movers: Any, hit: Any) -> None:
    """Nearer surface among the moving circles, where they are at the ray's instant.

    ``ray[5]``: seconds since the scan began. Rows of ``movers``: ``1, x, y, r, material, vx, vy``, true at that begin.
    """
    for k in range(movers.shape[0]):
        cx = movers[k, 1] + ray[5] * movers[k, 5]
        cy = movers[k, 2] + ray[5] * movers[k, 6]
        distance = meet_circle(ray, cx, cy, movers[k, 3])
        if distance < hit[0]:
            hit[0] = distance
            hit[1] = (ray[0] + distance * ray[2] - cx) / movers[k, 3]
            hit[2] = (ray[1] + distance * ray[3] - cy) / movers[k, 3]
            hit[3] = movers[k, 4]


@kernel("f8(f8, f8)")
def mirrored(at_normal: Any, cos_incidence: Any) -> Any:
    """Specular reflectance under incidence (Schlick 1994); none for a matt surface."""
    if at_normal <= 0.0:
        return 0.0
    return at_normal + (1.0 - at_normal) * (1.0 - cos_incidence) ** 5


@kernel("void(f8[:,::1], f8, f8)")
def add_echo(echoes: Any, reach: Any, energy: Any) -> None:
    """Append an echo while there is room; the last row holds the count."""
    count = int(echoes[-1, 0])
    if count < echoes.shape[0] - 1 and energy > 0.0:
        echoes[count, 0] = reach
        echoes[count, 1] = energy
        echoes[-1, 0] = count + 1


@kernel("b1(f8, f8, f8[:,::1])")
def on_rectangles(x: Any, y: Any, rectangles: Any) -> Any:
    """Whether a point lies on one of the rectangles."""
    for k in range(rectangles.shape[0]):
        if rectangles[k, 0] <= x <= rectangles[k, 2] and rectangles[k, 1] <= y <= rectangles[k, 3]:
            return True
    return False


@kernel("i8(f8[:,::1], i8, f8[::1], f8[::1], f8[::1])")
def branch(stack: Any, top: Any, ray: Any, hit: Any, surface: Any) -> Any:
    """Push what goes through and what is mirrored at a hit; returns the new top.

    Stack rows: ox, oy, dx, dy, travelled, gain (two-way), floor already met. ``ray[6:8]``: travelled and gain so far.
    ``surface``: share mirrored, share let through, floor flag.
    """
    x, y = ray[0] + hit[0] * ray[2], ray[1] + hit[0] * ray[3]
    along = ray[2] * hit[1] + ray[3] * hit[2]
    for mirror in range(2):
        gain = ray[7] * surface[1 - mirror] * surface[1 - mirror]
        if gain > MIN_GAIN and top < stack.shape[0]:
            dx, dy = ray[2] - 2.0 * mirror * along * hit[1], ray[3] - 2.0 * mirror * along * hit[2]
            stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3] = x + 1e-6 * dx, y + 1e-6 * dy, dx, dy
            stack[top, 4], stack[top, 5], stack[top, 6] = ray[6] + hit[0], gain, surface[2]
            top += 1
    return top


@kernel("void(f8[::1], f8[:,::1], f8[::1], f8[:,::1])")
def meet_floor(ray: Any, floors: Any, surface: Any, echoes: Any) -> None:
    """The scan plane dips into the floor: a matt floor ends the ray, a polished one passes most of it on."""
    ahead = ray[9] - ray[6]
    polished = on_rectangles(ray[0] + ahead * ray[2], ray[1] + ahead * ray[3], floors)
    share = mirrored(FLOOR_MIRROR, ray[10]) if polished else 0.0
    back = FLOOR_ALBEDO * (1.0 - share) * ray[10] / max(ray[9] * ray[9], 1e-4)
    add_echo(echoes, ray[9], ray[8] * ray[7] * back)
    ray[7] *= share * share
    surface[2] = 1.0


@kernel(f"void(f8[::1], {WORLD}, f8[:,::1], {WORK})")
def follow(ray: Any, world: Any, movers: Any, work: Any) -> None:
    """Follow one sub-ray through panes and mirrors and append its echoes.

    ``ray``: ox, oy, dx, dy, limit, time, travelled, gain, weight, floor distance (inf: never), sine of the elevation.
    """
    shapes, start, frame, table, floors = world
    stack, hit, surface, echoes = work
    stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = ray[0], ray[1], ray[2], ray[3]
    stack[0, 4], stack[0, 5], stack[0, 6] = 0.0, 1.0, 0.0
    top = 1
    limit = ray[4]
    while top > 0:
        top -= 1
        ray[0], ray[1], ray[2], ray[3] = stack[top, 0], stack[top, 1], stack[top, 2], stack[top, 3]
        ray[6], ray[7], surface[2] = stack[top, 4], stack[top, 5], stack[top, 6]
        ray[4] = limit - ray[6]
        hit[0] = inf
        meet_static(ray, shapes, start, frame, hit)
        meet_movers(ray, movers, hit)
        if surface[2] == 0.0 and ray[9] < limit and ray[9] - ray[6] < hit[0]:
            meet_floor(ray, floors, surface, echoes)
        if hit[0] > ray[4] or ray[7] < MIN_GAIN:
            continue
        material = int(hit[3])
        lean = min(fabs(ray[2] * hit[1] + ray[3] * hit[2]), 1.0)
        share = mirrored(table[material, 1], lean)
        reach = ray[6] + hit[0]
        back = table[material, 0] * (1.0 - share) * lean
        if share > 0.0:
            back += GLINT_GAIN * share * exp(-2.0 * (1.0 - lean) / (GLINT_WIDTH * GLINT_WIDTH))
        add_echo(echoes, reach, ray[8] * ray[7] * back / max(reach * reach, 1e-4))
        if share > 0.0:
            surface[0], surface[1] = share, (1.0 - share) * table[material, 2]
            top = branch(stack, top, ray, hit, surface)


@kernel("void(f8[:,::1], f8, f8, f8[:,::1])")
def detect(echoes: Any, threshold: Any, pulse: Any, out: Any) -> None:
    """What the receiver makes of a beam's echoes: up to three detections (range, energy, spread), first to last.

    Echoes closer together than the pulse is long melt into one (a mixed pixel); those too weak are not seen.
    """
    count = int(echoes[-1, 0])
    for i in range(1, count):
        reach, energy = echoes[i, 0], echoes[i, 1]
        j = i - 1
        while j >= 0 and echoes[j, 0] > reach:
            echoes[j + 1, 0], echoes[j + 1, 1] = echoes[j, 0], echoes[j, 1]
            j -= 1
        echoes[j + 1, 0], echoes[j + 1, 1] = reach, energy
    found = 0
    i = 0
    while i < count and found < out.shape[0]:
        total, first, second = 0.0, 0.0, 0.0
        k = i
        while k < count and echoes[k, 0] < echoes[i, 0] + pulse:
            excess = echoes[k, 0] - echoes[i, 0]
            total += echoes[k, 1]
            first += echoes[k, 1] * excess
            second += echoes[k, 1] * excess * excess
            k += 1
        if total >= threshold:
            mean = first / total
            out[found, 0] = echoes[i, 0] + mean
            out[found, 1] = total
            out[found, 2] = sqrt(max(second / total - mean * mean, 0.0))
            found += 1
            i = k
        else:
            i += 1


@kernel("void(f8[:,::1], f8[:,::1], i8, f8[::1], f8[::1])")
def aim(knots: Any, beams: Any, i: Any, optics: Any, start: Any) -> None:
    """Where beam ``i`` starts at its own instant: x, y, angle, limit, time, floor distance, sine of elevation."""
    at = beams[i, 1] * (knots.shape[0] - 1)
    k = min(int(at), knots.shape[0] - 2)
    part = at - k
    start[0] = knots[k, 0] + part * (knots[k + 1, 0] - knots[k, 0])
    start[1] = knots[k, 1] + part * (knots[k + 1, 1] - knots[k, 1])
    start[2] = knots[k, 2] + part * (knots[k + 1, 2] - knots[k, 2]) + beams[i, 0]
    start[3], start[4] = optics[1], beams[i, 1] * optics[6]
    down = optics[4] * cos(beams[i, 0]) + optics[5] * sin(beams[i, 0])
    start[5] = optics[3] / down if down > 1e-5 else inf
    start[6] = max(down, 0.0)


@kernel("void(f8[::1], f8, f8, f8[::1])")
def set_ray(start: Any, offset: Any, weight: Any, ray: Any) -> None:
    """One sub-ray of an aimed beam, ``offset`` rad beside its axis."""
    angle = start[2] + offset
    ray[0], ray[1], ray[2], ray[3] = start[0], start[1], cos(angle), sin(angle)
    ray[4], ray[5], ray[8], ray[9], ray[10] = start[3], start[4], weight, start[5], start[6]


@kernel(f"void(f8[:,::1], f8[:,::1], {WORLD}, f8[:,::1], f8[::1], f8[:,:,::1])")
def cast_scan(knots: Any, beams: Any, world: Any, movers: Any, optics: Any, out: Any) -> None:
    """Cast every beam of one scan from where the lidar is at that beam's instant.

    Args:
        knots: (k >= 2, 3) lidar poses evenly spaced over the scan, yaw unwrapped.
        beams: (n, 3) bearing, share of the scan's time passed (0..1), detection threshold.
        world: see :data:`WORLD`.
        movers: see :func:`meet_movers`.
        optics: half divergence, limit of range, pulse length, lidar height, pitch and roll (positive: the beams ahead
            and to the left point down), duration of the scan.
        out: (n, 3, 3) detections, see :func:`detect`; energy 0 where there is none.
    """
    out[:] = 0.0
    start, ray = np.zeros(7), np.zeros(11)
    echoes = np.zeros((ECHOES_PER_BEAM + 1, 2))
    work = (np.zeros((BRANCHES, 7)), np.zeros(4), np.zeros(3), echoes)
    for i in range(beams.shape[0]):
        echoes[-1, 0] = 0.0
        aim(knots, beams, i, optics, start)
        for sub in range(SUB_RAYS):
            set_ray(start, SUB_OFFSET[sub] * optics[0], SUB_WEIGHT[sub], ray)
            follow(ray, world, movers, work)
        detect(echoes, beams[i, 2], optics[2], out[i])
