"""The local map: recent line elements around the robot on one distance-region axis, bounded in number.

A keyframe's lines are merged into existing elements. A wall seen ten times is then one row of elements with a tenth of
the variance. Ten separate rows would bias the match, because the nearest one always fits too well. Elements not seen in
the recent keyframes are removed, and so are those seen through (people, doors). The cost of a match therefore depends
on the visible area, not on the time driven.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from estimator.measurements import Beam, Beams
from estimator.numerics import se2
from estimator.numerics.arrays import Array, Ints
from estimator.numerics.jit import kernel
from estimator.result import Virtual
from estimator.scan_matching.distance_axis import Axis, build_axis
from estimator.scan_matching.nearest_neighbour import nearest

X, Y, NX, NY, SLOPE, WEIGHT, SEEN, STRIKES = range(8)
"""Columns of an element: position, normal towards the sensor, direction variance (rad^2), and its counters.

WEIGHT: scans averaged. SEEN: number of the last update that saw it. STRIKES: number of times seen through since.
"""

WIDTH = 8
MARGIN = 0.1
"""Margin (m), beyond five times the range noise, of a beam that ends on an element or beyond it."""

SOLID_M, UNPROVED = 0.5, 0.1
"""A run longer than this (m) is structure; a smaller one (legs of people, of chairs) has the second value as weight."""

SAMPLES = 400
"""Approximate number of elements, and of points, in the free-space test of a pose."""

HIT = int(Beam.HIT)
UNSEEN: Beams = (np.empty(0), np.empty(0), np.empty(0, np.uint8))

WAVY = 0.03
"""Smallest sigma of a surface direction, rad: walls, skirtings and doors are not flat, and in every scan alike.

Without it the unevenness of its walls would seem to determine the pose along a corridor.
"""

ALIKE = 0.94
"""Smallest cosine between the normals of merged elements: 20 deg."""


@dataclass(frozen=True, slots=True)
class MapSettings:
    """Settings of the local map.

    Attributes:
        spacing_m: elements closer than this, or than half the beam spacing at their range, are merged.
        age: updates for which an element survives without being seen.
        weight: most scans in its average.
        capacity: most elements; the oldest are removed first.
        strikes: times it may be seen through, per scan averaged.
    """

    spacing_m: float = 0.025
    age: int = 20
    weight: float = 10.0
    capacity: int = 6000
    strikes: float = 0.3


class PlacedScan(Protocol):
    """A kept scan with its pose; `estimator.mapping.keyframe.Keyframe` implements it."""

    @property
    def T_odom_keyframe(self) -> Array:
        """Base in the odom frame, (x, y, yaw)."""

    @property
    def T_base_lidar(self) -> Array:
        """Mount of the lidar."""

    @property
    def T_odom_lidar(self) -> Array:
        """Lidar in the odom frame."""

    @property
    def bearing_rad(self) -> Array:
        """Bearings in the lidar frame, as the device measures them."""

    @property
    def virtual(self) -> Virtual | None:
        """The light solution at that instant, None where it is not valid."""

    def beams(self) -> Beams:
        """Beams in the lidar's frame at the end of the scan."""


@dataclass(slots=True, eq=False)
class LocalMap:
    """Elements (n, WIDTH) in the odom frame and their axis; ``lines`` (normal x, y, slope, weight) follow its rows."""

    elements: Array
    axis: Axis
    lines: Array
    updates: int = 0
    newest: PlacedScan | None = None


@kernel(
    "i8(f8[:, ::1], Tuple((f8[:, ::1], i8[::1], i8[::1], f8[:, ::1])), f8[::1], f8[:, ::1],"
    " Tuple((f8, f8, f8, f8, f8)), i8)",
    aside=True,
)
def absorb(
    elements: Array,
    axis: tuple[Array, Ints, Ints, Array],
    pose: Array,
    fresh: Array,
    how: tuple[float, float, float, float, float],
    count: int,
) -> int:
    """Merge lines (base frame) into the elements [0, count) and append new ones; returns the new count.

    ``axis``: rows, label, start, rays of the elements. ``pose``: T_odom_base (3), axis centre (2), lidar in the base
    frame (2). ``how``: update number, spacing, half a beam spacing in rad, residual noise, largest weight.
    """
    rows, label, start, rays = axis
    number, spacing, half_beam, sigma, most = how
    c, s = np.cos(pose[2]), np.sin(pose[2])
    last_x = last_y = np.inf
    for i in range(len(fresh)):
        x = pose[0] + c * fresh[i, 0] - s * fresh[i, 1]
        y = pose[1] + s * fresh[i, 0] + c * fresh[i, 1]
        nx = c * fresh[i, 2] - s * fresh[i, 3]
        ny = s * fresh[i, 2] + c * fresh[i, 3]
        r = np.sqrt((fresh[i, 0] - pose[5]) ** 2 + (fresh[i, 1] - pose[6]) ** 2)
        near = max(spacing, half_beam * r)
        row, _, _ = nearest(rows, start, rays, x - pose[3], y - pose[4], near * near)
        if row >= 0:
            j = label[row]
            e = elements[j, NX] * (x - elements[j, X]) + elements[j, NY] * (y - elements[j, Y])
            if elements[j, NX] * nx + elements[j, NY] * ny > ALIKE and abs(e) < 4.0 * sigma:
                if elements[j, SEEN] < number:
                    a = 1.0 / (elements[j, WEIGHT] + 1.0)
                    elements[j, X] += a * e * elements[j, NX]
                    elements[j, Y] += a * e * elements[j, NY]
                    b = elements[j, SLOPE] / (elements[j, SLOPE] + fresh[i, 4])
                    mx, my = (1.0 - b) * elements[j, NX] + b * nx, (1.0 - b) * elements[j, NY] + b * ny
                    length = np.sqrt(mx * mx + my * my)
                    elements[j, NX], elements[j, NY] = mx / length, my / length
                    elements[j, SLOPE] = max(fresh[i, 4] / most, elements[j, SLOPE] * (1.0 - b))
                    elements[j, WEIGHT] = min(most, elements[j, WEIGHT] + 1.0)
                    elements[j, SEEN] = number
                    elements[j, STRIKES] = 0.0
                continue
        if count == len(elements) or (x - last_x) ** 2 + (y - last_y) ** 2 < near * near:
            continue
        last_x, last_y = x, y
        elements[count, X], elements[count, Y] = x, y
        elements[count, NX], elements[count, NY] = nx, ny
        elements[count, SLOPE] = fresh[i, 4]
        elements[count, WEIGHT] = 1.0 if fresh[i, 5] > SOLID_M else UNPROVED
        elements[count, SEEN], elements[count, STRIKES] = number, 0.0
        count += 1
    return count


@kernel("void(f8[:, ::1], f8[::1], Tuple((f8[::1], f8[::1], u1[::1])), f8, i8, i1[::1])")
def look_at(
    elements: Array,
    eye: Array,
    beams: tuple[Array, Array, npt.NDArray[np.uint8]],
    margin: float,
    stride: int,
    said: npt.NDArray[np.int8],
) -> None:
    """Write the visibility of every ``stride``-th element in a scan from ``eye`` (x, y, yaw) to ``said``.

    1: a beam at its bearing, or a neighbouring one, ends on it. -1: it is seen through, as that beam and both
    neighbours end beyond it. 0: not judged; it is hidden, outside the field of view, or at a grazing angle.
    """
    bearing, distance, kind = beams
    n = len(bearing)
    said[:] = 0
    if n < 3 or bearing[n - 1] == bearing[0]:
        return
    per_beam = (bearing[n - 1] - bearing[0]) / (n - 1)
    turn = abs(2.0 * np.pi / per_beam)
    for i in range(0, len(elements), stride):
        dx, dy = elements[i, X] - eye[0], elements[i, Y] - eye[1]
        r = np.sqrt(dx * dx + dy * dy)
        facing = -(elements[i, NX] * dx + elements[i, NY] * dy)
        if elements[i, NX] == 0.0 and elements[i, NY] == 0.0:
            facing = r
        if facing < 0.3 * r:
            continue
        at = (np.arctan2(dy, dx) - eye[2] - bearing[0]) / per_beam
        at -= turn * np.floor((at - 0.5 * (n - 1)) / turn + 0.5)
        k = int(np.floor(at + 0.5))
        if k < 1 or k > n - 2:
            continue
        near = margin * r / facing
        beyond = 0
        for j in range(k - 1, k + 2):
            if kind[j] == 1 and abs(distance[j] - r) <= near:
                said[i] = 1
            elif kind[j] != 0 and distance[j] > r + near:
                beyond += 1
        if beyond == 3:
            said[i] = -1


def empty(origin: Array) -> LocalMap:
    """An empty map."""
    return LocalMap(np.empty((0, WIDTH)), build_axis(np.empty((0, 2)), origin), np.empty((0, 4)))


def update(local: LocalMap, frame: PlacedScan, lines: Array, settings: MapSettings, sigma: float) -> LocalMap:
    """The map after a keyframe with these lines (base frame): merged, aged, indexed around its lidar's position."""
    number, count, margin = local.updates + 1, len(local.elements), MARGIN + 5.0 * sigma
    fresh = lines if local.newest is None else standing(frame, lines, local.newest, margin)
    elements = np.empty((count + len(fresh), WIDTH))
    elements[:count] = local.elements
    axis, beams, eye = local.axis, frame.beams(), frame.T_odom_lidar
    n = len(beams[0])
    half_beam = 0.5 * abs(float(beams[0][-1] - beams[0][0])) / (n - 1) if n > 1 else 0.0
    pose = np.concatenate((frame.T_odom_keyframe, axis.centre, frame.T_base_lidar[:2]))
    how = (float(number), settings.spacing_m, half_beam, sigma, settings.weight)
    count = absorb(elements, (axis.rows, axis.label, axis.start, axis.rays), pose, fresh, how, count)
    elements = elements[:count]
    said = np.empty(count, np.int8)
    look_at(elements, eye, beams, margin, 1, said)
    elements[said < 0, STRIKES] += 1.0
    alive = elements[:, SEEN] > number - settings.age
    alive &= elements[:, STRIKES] <= settings.strikes * elements[:, WEIGHT]
    return index(elements[alive][-settings.capacity :], eye[:2], number, frame)


def standing(frame: PlacedScan, lines: Array, before: PlacedScan, margin: float) -> Array:
    """Lines of a keyframe without those where the previous keyframe saw free space: objects that have just moved in."""
    points = np.zeros((len(lines), 4))
    points[:, :2] = se2.apply(frame.T_odom_keyframe, lines[:, :2])
    said = np.empty(len(points), np.int8)
    look_at(points, before.T_odom_lidar, before.beams(), margin, 1, said)
    return lines[said >= 0]


@kernel("void(f8[:, ::1], i8[::1], f8[:, ::1])")
def lines_along(elements: Array, label: Ints, lines: Array) -> None:
    """Write normal, slope and weight of the elements in axis order; the weight as a share of one scan's noise."""
    for i in range(len(label)):
        j = label[i]
        lines[i, 0], lines[i, 1], lines[i, 2] = elements[j, NX], elements[j, NY], elements[j, SLOPE] + WAVY * WAVY
        lines[i, 3] = elements[j, WEIGHT] / (elements[j, WEIGHT] + 1.0)


def index(elements: Array, origin: Array, number: int, newest: PlacedScan | None) -> LocalMap:
    """Local map with the elements on an axis around ``origin``."""
    axis = build_axis(elements[:, :2], origin)
    lines = np.empty((len(elements), 4))
    lines_along(np.ascontiguousarray(elements), axis.label, lines)
    return LocalMap(elements, axis, lines, number, newest)


@kernel("f8(f8[:, ::1], f8[::1], Tuple((f8[::1], f8[::1], u1[::1])), f8[::1], Tuple((f8[::1], f8[::1], u1[::1])), f8)")
def speaking_against(
    elements: Array, eye: Array, beams: Beams, before: Array, beams_before: Beams, margin: float
) -> float:
    """Share of the tested evidence that contradicts a scan from ``eye``; ``before`` is the pose of an earlier scan."""
    step = max(1, len(elements) // SAMPLES)
    said = np.zeros(len(elements), np.int8)
    look_at(elements, eye, beams, margin, step, said)
    there = through = 0
    for i in range(0, len(said), step):
        there += said[i] > 0
        through += said[i] < 0
    bearing, distance, kind = beams
    hits = 0
    for i in range(len(kind)):
        hits += kind[i] == HIT
    step = max(1, hits // SAMPLES)
    points = np.zeros(((hits + step - 1) // step, WIDTH))
    at = 0
    for i in range(len(kind)):
        if kind[i] == HIT:
            if at % step == 0:
                angle = bearing[i] + eye[2]
                points[at // step, X] = eye[0] + distance[i] * np.cos(angle)
                points[at // step, Y] = eye[1] + distance[i] * np.sin(angle)
            at += 1
    said = np.zeros(len(points), np.int8)
    look_at(points, before, beams_before, margin, 1, said)
    for i in range(len(said)):
        there += said[i] > 0
        through += said[i] < 0
    return through / max(1, there + through)


def looked_through(local: LocalMap, T_odom_lidar: Array, beams: Beams, sigma: float) -> float:
    """Share of the elements in view that a scan from this pose sees through, of about 400 samples.

    This is half of the evidence of `contradicted`: a person who comes close stands in free space, but opens no walls.
    """
    return speaking_against(local.elements, T_odom_lidar, beams, T_odom_lidar, UNSEEN, MARGIN + 5.0 * sigma)


def contradicted(local: LocalMap, T_odom_lidar: Array, beams: Beams, sigma: float) -> float:
    """Free-space violation of a scan from this pose, of about 400 + 400 samples.

    It counts elements in view that the scan sees through. It also counts scan points where the newest keyframe saw free
    space.
    """
    newest, margin = local.newest, MARGIN + 5.0 * sigma
    before, beams_before = (T_odom_lidar, UNSEEN) if newest is None else (newest.T_odom_lidar, newest.beams())
    return speaking_against(local.elements, T_odom_lidar, beams, before, beams_before, margin)
