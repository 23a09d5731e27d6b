"""Corridors of equal doors: every place fits a door further on. The hardest building for who has a laser alone."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np

from tools.sim.building.building import Building
from tools.sim.building.people import Walker
from tools.sim.building.world import Array, Plan, Point
from tools.sim.robot.drive import Route

LENGTH: Final = 80.0
BLOCK: Final = 22.0
"""Depth of each of the two blocks between the three corridors along x."""
PITCH: Final = 3.6
DOOR: Final = 0.95
NICHE: Final = 0.08
"""By how much a closed door stands back behind its wall."""
ROOM: Final = 4.0


@dataclass(frozen=True, slots=True)
class Kind:
    """What tells such buildings apart.

    Attributes:
        width: of the corridors, m. every: one door in so many stands open, its room to be seen.
    """

    width: float = 2.6
    every: int = 4


def doors(kind: Kind, seed: int, people: int = 6) -> Building:
    """Two blocks with a corridor around each: three of 80 m along x and two across, equal doors on either side.

    Which doors stand open, and what stands in their rooms, differ between seeds. The tour goes round the whole twice,
    and round each block between: 950 m, back to its first corridor.
    """
    rng = np.random.default_rng((seed, 41))
    plan, w = Plan(), kind.width
    across = [k * (w + BLOCK) for k in range(3)]
    right, top = LENGTH + 2.0 * w, across[-1] + w
    _ring(plan, [(0.0, 0.0), (right, 0.0), (right, top), (0.0, top)], -1.0, kind, rng)
    for low in across[:2]:
        a, b, c, d = w, w + LENGTH, low + w, low + w + BLOCK
        _ring(plan, [(a, c), (b, c), (b, d), (a, d)], 1.0, kind, rng)
    half = 0.5 * w
    x0, x1 = half, right - half
    y0, y1, y2 = (y + half for y in across)
    whole: list[Point] = [(x1, y0), (x1, y2), (x0, y2), (x0, y0)]
    lower: list[Point] = [(x1, y0), (x1, y1), (x0, y1), (x0, y0)]
    upper: list[Point] = [(x1, y0), (x1, y2), (x0, y2), (x0, y1), (x1, y1), (x1, y2), (x0, y2), (x0, y0)]
    corners = [(0.3 * right, y0), *whole, *lower, *upper]
    walkers = tuple(
        Walker(((x0, y + 0.3 * w), (x1, y + 0.3 * w)), 0.9 + 0.1 * k, 7.0 * k)
        for k, y in enumerate(([y0, y1, y2] * people)[:people])
    )
    return Building("doors", plan.build(), Route(tuple(corners), 1.0), walkers)


def _ring(plan: Plan, corners: list[Point], inward: float, kind: Kind, rng: np.random.Generator) -> None:
    """A closed wall with its doors; ``corners`` counter-clockwise, doors to the left of it (1) or to the right (-1)."""
    points: list[Point] = []
    for a, b in pairwise([*corners, corners[0]]):
        points += _side(plan, np.array(a), np.array(b), inward, kind, rng)
    plan.outline(points)


def _side(plan: Plan, a: Array, b: Array, inward: float, kind: Kind, rng: np.random.Generator) -> list[Point]:
    """From a corner to the next one, without that."""
    length = float(np.hypot(*(b - a)))
    along = (b - a) / length
    off = inward * np.array((-along[1], along[0]))
    count = int((length - 2.0 * ROOM) / PITCH)  # rooms at corners would meet those round them
    begin, points = 0.5 * (length - (count - 1) * PITCH), [a]
    for k in range(count):
        at = a + along * (begin + k * PITCH)
        near, far = at - 0.5 * DOOR * along, at + 0.5 * DOOR * along
        if rng.integers(kind.every):
            points += [near, near + NICHE * off, far + NICHE * off, far]
            continue
        left, right = at - 0.45 * PITCH * along, at + 0.45 * PITCH * along
        thick, back = 0.12 * off, ROOM * off
        points += [near, near + thick, left + thick, left + back, right + back, right + thick, far + thick, far]
        stands = at + rng.uniform(-1.0, 1.0) * along + rng.uniform(1.5, 3.2) * off
        plan.box((float(stands[0]), float(stands[1])), (0.9, 0.5), float(rng.uniform(0.0, np.pi)), "wood")
    return [(float(x), float(y)) for x, y in points]
