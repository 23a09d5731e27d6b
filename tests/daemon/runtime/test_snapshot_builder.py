"""What a snapshot says of guesses and of loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from daemon.integrity.state_memory import Memory
from daemon.runtime.snapshot_builder import Facts, SnapshotBuilder
from daemon.snapshot import State
from estimator.result import Loop, StepResult


def test_how_sure_a_guess_is_is_not_said() -> None:
    """While the place in the map is looked for the pose goes on, and neither axes nor deviations are known."""
    told = StepResult(
        1.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.ones(3), None, -1, None, 0, np.zeros(3), 0
    )
    verdict = Memory(State.RELOCATING, known=(True, True, True))
    sure, guess = (SnapshotBuilder().build(replace(told, places=places), verdict, Facts()) for places in (None, 2))
    assert sure.covariance is not None
    assert sure.known == (True, True, True)
    assert guess.pose is not None
    assert guess.covariance is None
    assert guess.known == (False, False, False)


def test_a_loop_is_latched_until_somebody_has_seen_it() -> None:
    told = StepResult(
        1.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.ones(3), None, -1, None, 0, np.zeros(3), 0
    )
    builder, verdict = SnapshotBuilder(), Memory()

    def latched(counter: int | None) -> bool:
        loop = None if counter is None else Loop(counter, 9, 2, 0.01)
        return builder.build(replace(told, loop=loop), verdict, Facts()).loop_latched

    assert [latched(None), latched(1), latched(None)] == [False, True, True]
    builder.loop_seen = 1
    assert [latched(None), latched(2)] == [False, True]
    builder.loop_seen = 1
    assert latched(None), "an acknowledgement that comes late loses no loop"
    builder.loop_seen = 0
    assert not latched(2**16), "the counter wraps"
