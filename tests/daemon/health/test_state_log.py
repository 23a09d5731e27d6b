"""Lines of the state: each change of a quiet run, a few of a run that flickers, and always the last one."""

import logging
import re

import pytest

from daemon.health.reasons import Reason
from daemon.health.state_log import INTERVAL_S, LINES, StateLog
from daemon.snapshot import State

GOOD = State.TRACKING, Reason.NONE
POOR = State.DEGRADED, Reason.LIDAR_SILENT


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> pytest.LogCaptureFixture:
    caplog.set_level(logging.INFO)
    return caplog


def test_changes_that_come_now_and_then_are_logged_at_once(lines: pytest.LogCaptureFixture) -> None:
    log = StateLog(*GOOD)
    for cycle in range(400):
        log.on_cycle(0.1 * cycle, *(POOR if (cycle // 100) % 2 else GOOD))
        assert len(lines.messages) == cycle // 100
    assert lines.messages[0].startswith("DEGRADED: no valid scan for three scan periods")
    assert lines.messages[1] == "TRACKING: the pose is confirmed"


def test_a_state_that_flickers_is_damped_and_the_number_of_changes_is_logged(lines: pytest.LogCaptureFixture) -> None:
    log, changes = StateLog(*GOOD), 0
    for cycle in range(6000):  # ten minutes
        changes += cycle % 5 == 0
        log.on_cycle(0.1 * cycle, *(POOR if changes % 2 else GOOD))
    assert 60 <= len(lines.messages) <= LINES * (600.0 / INTERVAL_S + 1)
    assert any(re.search(r"; \d+ changes since the previous line", text) for text in lines.messages)


def test_the_last_line_is_the_present_state(lines: pytest.LogCaptureFixture) -> None:
    for changes in range(2, 30):
        log = StateLog(*GOOD)
        lines.clear()
        for cycle in range(200):
            state = (POOR if cycle % 2 else GOOD) if cycle < changes else GOOD if changes % 3 else POOR
            log.on_cycle(0.1 * cycle, *state)
        if lines.messages:
            assert lines.messages[-1].startswith(state[0].name)
        else:
            assert state == GOOD


def test_a_state_that_does_not_change_has_no_line(lines: pytest.LogCaptureFixture) -> None:
    log = StateLog(*GOOD)
    for cycle in range(1000):
        log.on_cycle(0.1 * cycle, *GOOD)
    assert not lines.messages
