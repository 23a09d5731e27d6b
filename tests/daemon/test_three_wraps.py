"""The sensor's clock of 24 bits wraps three times in fourteen hours of driving: the pose goes on as if nothing were."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import pytest

from daemon.publish.snapshot import State
from tools.bench.world.room import LIDAR, room
from tools.sim.harness import run
from tools.sim.odometry import Wheels
from tools.sim.robot import Body
from tools.sim.scene import Scenario, SimulatedScene

WRAP_S: Final = 1e-3 * (1 << 24)
WRAPS: Final = 3
AROUND_S: Final = 30.0
SLOW_LIDAR: Final = replace(LIDAR, ares=180, amax=90, afrt=45, rpm=60, true_period_s=1.0)
"""91 beams, one scan a second."""


@pytest.mark.jit
@pytest.mark.slow
def test_three_wraps_move_no_pose() -> None:
    scenario = Scenario(lidar=SLOW_LIDAR, people=False, wheels=Wheels(rate_hz=2.0), body=Body(speed=0.2))
    driven = run(WRAPS * WRAP_S + 600.0, scene=SimulatedScene(scenario, room()))
    off = np.hypot(*(driven.pose - driven.truth)[:, :2].T)
    told = driven.snapshots
    assert told[-1].jumps == 0
    assert told[-1].missed == 0
    from_first = next(k for k, one in enumerate(told) if one.state is State.TRACKING)
    assert {one.state for one in told[from_first:]} == {State.TRACKING}
    for wrap in range(1, WRAPS + 1):
        near = np.abs(driven.t_mono - driven.t_mono[0] - wrap * WRAP_S) < AROUND_S
        assert near.sum() > AROUND_S
        assert off[near].max() < 0.05
    assert np.nanmax(off) < 0.05
