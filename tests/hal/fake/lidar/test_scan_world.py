"""The scan sources of the fake lidar: the room, and recorded ranges."""

from __future__ import annotations

import numpy as np
import pytest

from hal.fake.lidar.models import UTM_30LX
from hal.fake.lidar.scan_world import Room


def test_room_is_seen_as_it_is() -> None:
    """The back wall and the right-hand wall, as the sensor sees them from where it is."""
    room = Room(UTM_30LX, noise_mm=0.0)
    scan = room(0.0)
    x, y, heading = room.pose(np.array([540 / 1440 * UTM_30LX.true_period_s]))[0]
    assert heading == pytest.approx(np.pi / 2, abs=0.01)  # looking along +y
    ahead, right = scan.ranges_mm[540], scan.ranges_mm[540 - 360]
    assert ahead == pytest.approx(1e3 * (5.0 - y), abs=5)
    assert right == pytest.approx(1e3 * (7.0 - x), abs=5)
    assert room(15.0).ranges_mm[540] != ahead
    assert scan.ranges_mm.min() > 300
    assert np.array_equal(Room(UTM_30LX, seed=3)(1.0).ranges_mm, Room(UTM_30LX, seed=3)(1.0).ranges_mm)
