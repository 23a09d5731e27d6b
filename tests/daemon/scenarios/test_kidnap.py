"""The whole daemon when the robot is carried off in mid-run, as those who read its pose over Modbus and UDP see it."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.publish.modbus.registers import decode_block, decode_datagram, encode_block, encode_datagram
from daemon.snapshot import State
from tools.sim.harness import Run, run
from tools.sim.light.scene import LINK, Lights
from tools.sim.scene import Scenario

pytestmark = [pytest.mark.slow, pytest.mark.jit]

UP, DOWN, END = 34.0, 36.0, 54.0
ORDER = f'[[fault]]\nwhere = "robot"\nwhat = "carry"\nwhen = {UP}\nahead = 32.0\ntakes = {DOWN - UP}\n'


@pytest.fixture(scope="module")
def carried() -> Run:
    """Once through most of the paper's room, then to another side of it."""
    return run(END, Scenario(lidar="UST-10LX", lights=Lights(LINK), seed=1, dwell_s=0.5), faults=ORDER)


def part(out: Run, begin: float, end: float) -> slice:
    """Rows between two instants since the first scan."""
    t = out.t_mono - out.t_mono[0]
    return slice(int(np.searchsorted(t, begin)), int(np.searchsorted(t, end)))


def test_it_is_found_again_where_it_was_put_down(carried: Run) -> None:
    before, after = part(carried, UP - 5.0, UP - 0.5), part(carried, DOWN + 3.0, END)
    assert np.mean(carried.state[before] == State.TRACKING) > 0.9
    moved = np.hypot(*(carried.site[after.start] - carried.site[before.stop])[:2])
    assert moved > 3.0
    assert np.median(carried.error_m[before]) < 0.1
    assert np.max(carried.error_m[after]) < 0.3
    assert np.degrees(np.max(np.abs(carried.error_rad[after]))) < 5.0
    assert carried.state[-1] == State.TRACKING


def test_it_never_says_tracking_of_a_wrong_place(carried: Run) -> None:
    """Half a second is what noticing may take, with light."""
    wrong = (carried.state == State.TRACKING) & ((carried.error_m > 0.5) | (np.abs(carried.error_rad) > 0.09))
    runs = np.diff(np.flatnonzero(np.diff(np.concatenate([[0], wrong.astype(int), [0]]))))[::2]
    assert np.max(runs, initial=0) <= 0.5 * 40


def test_who_reads_it_over_modbus_and_udp_sees_state_and_jumps(carried: Run) -> None:
    before, after = (carried.snapshots[k] for k in (part(carried, UP - 1.0, UP).start, -1))
    lost = {snapshot.state for snapshot in carried.snapshots[part(carried, UP, DOWN + 3.0)]}
    assert lost & {State.LOST, State.RELOCATING, State.AMBIGUOUS, State.DEGRADED}
    for read in (lambda s: decode_block(encode_block(s)), lambda s: decode_datagram(encode_datagram(s))):
        first, last = read(before), read(after)
        assert int(first["state"] or 0) == int(last["state"] or 0) == State.TRACKING
        assert int(last["jumps"] or 0) > int(first["jumps"] or 0)
