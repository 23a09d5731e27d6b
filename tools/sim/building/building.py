"""A building: its walls, the route of a robot through it, and people who walk there."""

from __future__ import annotations

from dataclasses import dataclass

from tools.sim.building.people import Walker
from tools.sim.building.world import SimWorld
from tools.sim.robot.drive import Route


@dataclass(frozen=True, slots=True, eq=False)
class Building:
    """A world with its tour; ``height_m`` is the ceiling's."""

    name: str
    world: SimWorld
    route: Route
    people: tuple[Walker, ...] = ()
    height_m: float = 3.0
