"""The building of equal doors: its tour stays in its corridors, and as many doors stand open as asked for."""

from __future__ import annotations

import numpy as np
import pytest

from tools.sim.building.doors import Kind, doors
from tools.sim.robot.drive import Body, Drive


@pytest.mark.parametrize("width", [2.6, 5.0])
def test_the_tour_keeps_to_the_corridors(width: float) -> None:
    place = doors(Kind(width, 4), 1)
    drive = Drive(place.route, Body(), 2.0, 1)
    at = drive.pose(np.arange(0.0, drive.lap_s, 0.5))[:, :2]
    assert float(np.min(place.world.clearance(at))) > 0.3 * width


def test_fewer_open_doors_are_fewer_walls_and_seeds_differ() -> None:
    few, many = (len(doors(Kind(2.6, every), 1).world.shapes) for every in (17, 4))
    assert few < many
    one, same, other = (doors(Kind(), seed).world.shapes for seed in (1, 1, 2))
    assert np.array_equal(one, same)
    assert not np.array_equal(one, other)
