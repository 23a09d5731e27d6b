"""Lamp placement by greedy D-optimal design: adds the most informative lamp until the goals are met.

The worth of a set of lamps is a sum over places. It adds the log-determinant of the information by lidar and light, and
the number of wanted links present. Both grow more slowly with every lamp. Greedy selection therefore comes within 63 %
of the optimum (Nemhauser, Wolsey, Fisher 1978). The earlier gain of a position is an upper bound of its present gain.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.commissioning.floor import Array, Hall
from daemon.commissioning.light_information import Fitting, Seen, information, seen_from, worst

PRIOR: Final = 1.0 / 0.5**2
"""Prior information of a robot with a sigma of half a metre on each axis, 1/m^2."""
WALLS_MOST: Final = 1.0 / 0.05**2
"""Upper limit of the lidar's information, 1/m^2: light must be an independent solution."""
LINK_WORTH: Final = 0.7
"""Worth of a further link where there are too few, in units of the log-determinant."""


@dataclass(frozen=True, slots=True)
class Goals:
    """Goals that end the selection.

    Attributes:
        links: wanted at a place. accuracy: wanted sigma by light alone, m.
        share: of the places at which both must hold. most: limit of lamps; exact: number of lamps, whatever the goals.
    """

    links: int = 4
    accuracy: float = 0.10
    share: float = 0.95
    most: int = 500
    exact: int | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Selected lamps and their effect.

    Attributes:
        lamps: (k, 2) in the plan's frame, m. links: (n,) at each place. light: (n, 3) information by light, 1/m^2;
            walls: by the lidar. reached: share of the places where both goals hold.
        possible: (n,) whether the goals could hold there with a lamp at every possible position.
    """

    lamps: Array
    links: npt.NDArray[np.int64]
    light: Array
    walls: Array
    reached: float
    possible: npt.NDArray[np.bool_]

    def short_of(self, goals: Goals) -> str:
        """Returns why the goals are not reached where they could be, or why lamps are missing; empty otherwise."""
        count = len(self.lamps)
        if goals.exact is not None:
            return "" if count >= goals.exact else f"only {count} positions remain where another lamp improves the plan"
        share = self.reached / max(1e-9, float(self.possible.mean()))
        if share >= goals.share or not self.possible.any():
            return ""
        why = f"limit of {goals.most} lamps" if count >= goals.most else "no further position improves the plan"
        return f"goal NOT reached ({why}); {100.0 * share:.1f} % of the positions that can reach it"

    @property
    def light_sigma(self) -> Array:
        """(n,) sigma of the worse axis by light alone, m."""
        return worst(self.light)[0]

    @property
    def sigma(self) -> Array:
        """(n,) sigma of the worse axis by lidar and light, m."""
        return worst(self.light + self.walls)[0]


class _Sum:
    """Information and links of all selected lamps at every place."""

    def __init__(self, count: int, walls: Array, goals: Goals) -> None:
        self.told = np.zeros((count, 6))
        self.links = np.zeros(count, np.int64)
        self.goals = goals
        trusted = np.minimum(walls[:, [0, 2]], WALLS_MOST)
        shrunk = np.sqrt(trusted[:, 0] * trusted[:, 1] / np.maximum(walls[:, 0] * walls[:, 2], 1e-12))
        self._base = np.column_stack((PRIOR + trusted[:, 0], walls[:, 1] * shrunk, PRIOR + trusted[:, 1]))
        self._now = self._worth(np.arange(count), self.told, self.links)

    def add(self, seen: Seen, sign: int = 1) -> None:
        """Adds one lamp (``sign`` -1: removes it)."""
        at = seen.places
        self.told[at] += sign * seen.told
        self.links[at] += sign
        self._now[at] = self._worth(at, self.told[at], self.links[at])

    def gain(self, seen: Seen) -> float:
        """Returns the increase of the worth by one more lamp."""
        at = seen.places
        return float((self._worth(at, self.told[at] + seen.told, self.links[at] + 1) - self._now[at]).sum())

    def met(self) -> npt.NDArray[np.bool_]:
        """Returns the mask (n,) of places where both goals hold."""
        sigma, _ = worst(information(self.told))
        return np.asarray((self.links >= self.goals.links) & (sigma <= self.goals.accuracy))

    def _worth(self, at: npt.NDArray[np.int64], told: Array, links: npt.NDArray[np.int64]) -> Array:
        info = information(told) + self._base[at]
        determinant = np.maximum(info[:, 0] * info[:, 2] - info[:, 1] ** 2, 1e-9)
        return np.asarray(0.5 * np.log(determinant) + LINK_WORTH * np.minimum(links, self.goals.links))


def choose(hall: Hall, fitting: Fitting, walls: Array, goals: Goals) -> Plan:
    """Selects lamps for a floor plan."""
    spots = [seen_from(hall, fitting, spot) for spot in hall.spots]
    everywhere = _Sum(len(hall.places), walls, goals)
    for seen in spots:
        everywhere.add(seen)
    possible = everywhere.met()
    total = _Sum(len(hall.places), walls, goals)
    chosen = _greedy(total, spots, possible)
    if goals.exact is None:
        chosen = _without_needless(total, spots, chosen, possible)
    return Plan(
        hall.spots[chosen],
        total.links,
        information(total.told),
        walls,
        float(total.met().mean()),
        possible,
    )


def plan_of(hall: Hall, fitting: Fitting, walls: Array, goals: Goals, lamps: Array) -> Plan:
    """Returns the effect of installed lamps, (k, 2) m in the plan's frame."""
    total = _Sum(len(hall.places), walls, goals)
    for lamp in lamps:
        total.add(seen_from(hall, fitting, lamp))
    possible = np.ones(len(hall.places), np.bool_)
    return Plan(lamps, total.links, information(total.told), walls, float(total.met().mean()), possible)


def _enough(total: _Sum, possible: npt.NDArray[np.bool_], count: int) -> bool:
    goals = total.goals
    if goals.exact is not None:
        return count >= goals.exact
    if count >= goals.most or not possible.any():
        return True
    return bool(total.met()[possible].mean() >= goals.share)


def _greedy(total: _Sum, spots: Sequence[Seen], possible: npt.NDArray[np.bool_]) -> list[int]:
    heap = [(-total.gain(seen), index) for index, seen in enumerate(spots)]
    heapq.heapify(heap)
    chosen: list[int] = []
    while heap and not _enough(total, possible, len(chosen)):
        while True:
            _, index = heapq.heappop(heap)
            gain = total.gain(spots[index])
            if not heap or gain >= -heap[0][0] - 1e-9:
                break
            heapq.heappush(heap, (-gain, index))
        if gain <= 0.0:
            break
        total.add(spots[index])
        chosen.append(index)
    return chosen


def _without_needless(
    total: _Sum, spots: Sequence[Seen], chosen: list[int], possible: npt.NDArray[np.bool_]
) -> list[int]:
    """Removes lamps that the goals do not need, the oldest first: later lamps make some early ones superfluous."""
    kept = list(chosen)
    for index in chosen:
        if not _enough(total, possible, 0):
            break
        total.add(spots[index], -1)
        if _enough(total, possible, 0):
            kept.remove(index)
        else:
            total.add(spots[index])
    return kept


def codes_for(lamps: Array, count: int) -> tuple[list[int], float]:
    """Assigns one of ``count`` codes to each lamp (k, 2).

    Also returns the least distance of two equal codes, m or infinite.
    """
    given: list[int] = []
    least = float("inf")
    for index, lamp in enumerate(lamps):
        if index < count:
            given.append(index)
            continue
        far = np.hypot(*(lamps[:index] - lamp).T)
        nearest = np.full(count, np.inf)
        np.minimum.at(nearest, np.array(given), far)
        code = int(np.argmax(nearest))
        given.append(code)
        least = min(least, float(nearest[code]))
    return given, least
