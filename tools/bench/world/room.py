"""The benches' own room and lidar: small enough for an emulated computer, unlike itself everywhere."""

from dataclasses import replace
from typing import Final

from hal.fake.lidar.models import MODELS, PAPER, LidarModel
from tools.sim.building.building import Building
from tools.sim.building.buildings import building
from tools.sim.building.world import Plan
from tools.sim.robot.drive import Route

BENCH: Final = "bench"
LIDAR: Final[LidarModel] = replace(
    PAPER, modl="BENCH-180[180 degrees, 181 beams, 5 Hz]", ares=360, amax=180, afrt=90, rpm=300, true_period_s=0.2
)
"""180 degrees, 181 beams, 5 Hz, on USB: what an emulated computer can keep up with."""
LAP_CORNERS: Final = ((-2.6, -1.9), (2.4, -1.9), (2.4, 1.6), (-2.6, 1.6))
"""17 m."""


def room() -> Building:
    """9 x 7 m with things that make every place in it look like no other."""
    plan = Plan()
    for start, end in (((-4.5, -3.5), (4.5, -3.5)), ((4.5, -3.5), (4.5, 3.5)), ((4.5, 3.5), (-4.5, 3.5))):
        plan.line(start, end)
    plan.line((-4.5, 3.5), (-4.5, 1.0))
    plan.line((-4.5, 1.0), (-5.3, 1.0))
    plan.line((-5.3, 1.0), (-5.3, -3.5))
    plan.line((-5.3, -3.5), (-4.5, -3.5))
    plan.box((3.6, 2.8), (1.4, 0.8), 0.0, "wood")
    plan.box((-3.4, -3.0), (0.7, 0.7), 0.4, "wood")
    plan.circle((0.3, 0.2), 0.3)
    plan.circle((-1.2, 3.0), 0.2)
    return Building(BENCH, plan.build(), Route(LAP_CORNERS, 1.2))


def place(name: str) -> Building:
    """This room, or one of the simulator's buildings; raises ValueError that lists them."""
    return room() if name == BENCH else building(name)


def model(name: str) -> LidarModel:
    """This lidar, or one of the fakes'; raises ValueError that lists them."""
    if name != BENCH and name not in MODELS:
        raise ValueError(f"no lidar is called {name!r}; there are: {BENCH}, {', '.join(MODELS)}")
    return LIDAR if name == BENCH else MODELS[name]
