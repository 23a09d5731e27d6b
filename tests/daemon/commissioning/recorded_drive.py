"""A recorded teach drive: the whole daemon on the simulated robot under simulated lamps, in virtual time."""

from dataclasses import replace
from pathlib import Path

from tools.sim.building.buildings import building
from tools.sim.harness import run
from tools.sim.light.link_drive import ROOM_BODY, ROOM_ROUTE
from tools.sim.light.scene import Lights
from tools.sim.scene import Scenario, SimulatedScene


def scene() -> SimulatedScene:
    """The paper's room with its lamps and nobody in it; the robot drives up and down and across it."""
    place = replace(building("paper_room"), route=ROOM_ROUTE)
    return SimulatedScene(Scenario(people=False, laps=1, body=ROOM_BODY, lights=Lights()), place)


def record(folder: Path, seconds: float) -> SimulatedScene:
    """Record that many seconds; returns the scene, which knows the truth."""
    made = scene()
    run(seconds, scene=made, record=folder)
    return made
