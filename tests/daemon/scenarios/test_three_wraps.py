"""The sensor's clock of 24 bits wraps three times in fourteen hours of driving: the pose goes on as if nothing were.

And once in two and a half minutes, its clock set to shortly before: the same is asked of it, and is seen to fail there
where nothing unwraps the clock.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import pytest

from daemon.snapshot import State
from hal.fake.lidar.models import Unit
from hal.hokuyo import ticks
from tools.bench.world.room import LIDAR, room
from tools.sim import harness
from tools.sim.harness import Run, run
from tools.sim.robot.drive import Body
from tools.sim.robot.odometry import Wheels
from tools.sim.scene import Scenario, SimulatedScene

MODULUS_MS: Final = 1 << 24
WRAP_S: Final = 1e-3 * MODULUS_MS
WRAPS: Final = 3
AROUND_S: Final = 30.0
SOON_S: Final = 120.0
"""Where the clock is set to shortly before its wrap: by then the driver has learned it, and the pose is TRACKING."""
STEP_M: Final = 0.02
PERIOD_S: Final = 1.0
EVEN_S: Final = 0.01
SLOW_LIDAR: Final = replace(LIDAR, ares=180, amax=90, afrt=45, rpm=60, true_period_s=PERIOD_S)
"""91 beams, one scan a second."""


def driven(seconds: float) -> Run:
    body, wheels = Body(speed=0.1, turn_rate=0.2), Wheels(rate_hz=10.0)
    scene = SimulatedScene(Scenario(lidar=SLOW_LIDAR, people=False, wheels=wheels, body=body), room())
    return run(seconds, scene=scene)


def goes_on(drive: Run, wrap_s: float) -> None:
    """Around so many seconds after the first pose: every scan is there in its time, nothing is told, nothing moves."""
    t = drive.t_mono - drive.t_mono[0] - wrap_s
    near = np.flatnonzero(np.abs(t) < AROUND_S)
    told = [drive.snapshots[k] for k in near]
    assert len(told) > 1.9 * AROUND_S
    uneven = np.abs(np.diff(t[near]) - PERIOD_S)
    assert uneven.max() < EVEN_S, "a pose without a scan, or at another instant than the scan's"
    assert {(one.state, one.fault, one.jumps, one.missed) for one in told} == {
        (State.TRACKING, 0, told[0].jumps, told[0].missed)
    }
    steps = np.hypot(*np.diff((drive.pose - drive.truth)[near, :2], axis=0).T)
    assert steps.max() < STEP_M, "from scan to scan, against the truth"


@pytest.mark.jit
@pytest.mark.slow
@pytest.mark.timeout(900)
def test_three_wraps_move_no_pose() -> None:
    """Nothing is said of the hours between: so slow a lidar, of so few beams, loses itself now and then."""
    drive = driven(WRAPS * WRAP_S + 2.0 * AROUND_S)
    for wrap in range(1, WRAPS + 1):
        goes_on(drive, wrap * WRAP_S)


@pytest.fixture
def wraps_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(harness, "Unit", partial(Unit, clock_ms=MODULUS_MS - round(1e3 * SOON_S)))


@pytest.mark.jit
@pytest.mark.usefixtures("wraps_soon")
def test_a_wrap_moves_no_pose() -> None:
    goes_on(driven(SOON_S + 1.2 * AROUND_S), SOON_S)


@pytest.mark.jit
@pytest.mark.usefixtures("wraps_soon")
def test_a_clock_that_is_not_unwrapped_is_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it a stamp is taken as it is: what is asked above is not met, so it is not met by chance either."""
    monkeypatch.setattr(ticks, "TICK_MODULUS", 1 << 40)
    drive = driven(SOON_S + 1.2 * AROUND_S)
    with pytest.raises(AssertionError, match="a pose without a scan"):
        goes_on(drive, SOON_S)
    goes_on(drive, SOON_S - 1.1 * AROUND_S)  # it is the wrap that is seen, and nothing else
