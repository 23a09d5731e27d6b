"""The computer's clock is set, the sensor's clock wraps: neither moves a pose, changes a state, or is a fault."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest

from daemon.snapshot import Snapshot, State
from hal.clock import LoopClock
from hal.fake.lidar.models import Unit
from tests.daemon.scenarios.test_daemon import Bench, run_daemon

WRAP = 1 << 24
END_S = 14.0


def snapshots(unit: Unit | None = None) -> list[Snapshot]:
    async def scenario(bench: Bench) -> None:
        await asyncio.sleep(END_S)
        assert bench.last.state is State.TRACKING

    return run_daemon(scenario, unit=unit or Unit()).snapshots


def timeless(taken: list[Snapshot]) -> list[Snapshot]:
    return [replace(snapshot, t_utc=0.0) for snapshot in taken]


@pytest.fixture(scope="module")
def plain() -> list[Snapshot]:
    """Of a run in which nothing happens."""
    return snapshots()


@pytest.mark.parametrize("step_s", [1e2, 1e5, 1e8, pytest.param(-1e8, marks=pytest.mark.slow)])
def test_a_step_of_the_computers_clock_moves_no_pose(
    step_s: float, plain: list[Snapshot], monkeypatch: pytest.MonkeyPatch
) -> None:
    utc = LoopClock.utc

    def stepped(clock: LoopClock) -> float:
        return utc(clock) + (step_s if clock.now() > 0.5 * END_S else 0.0)

    monkeypatch.setattr(LoopClock, "utc", stepped)
    after = snapshots()
    assert max(s.t_utc for s in after) - min(s.t_utc for s in after) > 0.9 * abs(step_s)
    assert timeless(after) == timeless(plain)


SLOW = pytest.mark.slow


@pytest.mark.parametrize("gain", [0.0, pytest.param(1e-3, marks=SLOW), pytest.param(-1e-3, marks=SLOW)])
def test_a_wrap_of_the_sensors_clock_moves_no_pose(gain: float, plain: list[Snapshot]) -> None:
    """Within what a millisecond of another phase does: the sensor counts whole ones."""
    straight = snapshots(Unit(clock_gain=gain)) if gain else plain
    wrapped = snapshots(Unit(clock_gain=gain, clock_ms=WRAP - 7000))
    assert [(s.state, s.reason, s.fault, s.missed) for s in wrapped] == [
        (s.state, s.reason, s.fault, s.missed) for s in straight
    ]
    for one, other in zip(straight, wrapped, strict=True):
        if one.pose is not None and other.pose is not None:
            assert abs(one.t_mono - other.t_mono) < 2e-3
            assert max(abs(a - b) for a, b in zip(one.pose, other.pose, strict=True)) < 5e-3
