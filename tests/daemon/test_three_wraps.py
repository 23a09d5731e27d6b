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
STEP_M: Final = 0.02
SLOW_LIDAR: Final = replace(LIDAR, ares=180, amax=90, afrt=45, rpm=60, true_period_s=1.0)
"""91 beams, one scan a second."""


@pytest.mark.jit
@pytest.mark.slow
def test_three_wraps_move_no_pose() -> None:
    """Nothing is said of the hours between: so slow a lidar, of so few beams, loses itself now and then."""
    body, wheels = Body(speed=0.1, turn_rate=0.2), Wheels(rate_hz=10.0)
    scene = SimulatedScene(Scenario(lidar=SLOW_LIDAR, people=False, wheels=wheels, body=body), room())
    driven = run(WRAPS * WRAP_S + 2.0 * AROUND_S, scene=scene)
    off = (driven.pose - driven.truth)[:, :2]
    for wrap in range(1, WRAPS + 1):
        t = driven.t_mono - driven.t_mono[0] - wrap * WRAP_S
        near = np.flatnonzero(np.abs(t) < AROUND_S)
        told = [driven.snapshots[k] for k in near]
        assert len(told) > 1.9 * AROUND_S
        assert {(one.state, one.fault, one.jumps, one.missed) for one in told} == {
            (State.TRACKING, 0, told[0].jumps, told[0].missed)
        }
        steps = np.hypot(*np.diff(off[near], axis=0).T)
        assert steps.max() < STEP_M, "from scan to scan, against the truth"
