"""What a sensor reports of itself goes with the error; a healthy report does not."""

from __future__ import annotations

import pytest

from hal.errors import DataInvalid, DeviceFault
from hal.hokuyo.sensor_errors import AbnormalState, NotReady, SelfReport, StartingUp, explain_status


def test_the_sensors_own_words_go_with_the_error() -> None:
    report = SelfReport("IDLE", "Trouble!! Error No. =[00->33]")
    assert "Trouble!! Error No. =[00->33]" in str(explain_status("/dev/x", "MD", "50", report))


@pytest.mark.parametrize("health", ["", "Sensor works well.", "Stable 000 no error.", "sensor is working normally"])
def test_a_healthy_report_is_none(health: str) -> None:
    assert "reports" not in str(explain_status("/dev/x", "MD", "50", SelfReport("IDLE", health)))


@pytest.mark.parametrize("health", ["Unstable 100 no error.", "Abnormal state", "Error: laser", "anything else"])
def test_any_other_report_is_repeated_once(health: str) -> None:
    report = SelfReport("IDLE", health)
    error = explain_status("/dev/x", "MD", "50", report)
    assert str(report.added_to(error)).count(health) == 1


@pytest.mark.parametrize(
    ("report", "starting"),
    [
        (SelfReport("001 Booting"), True),
        (SelfReport("IDLE", "Warming up"), True),
        (SelfReport("006 Waking"), True),
        (SelfReport("000 Idle", "Stable 000 no error."), False),
        (SelfReport("Measuring by Normal Mode"), False),
        (SelfReport("IDLE", "Error, restart the sensor"), False),
        (SelfReport("IDLE", "Start failed"), False),
    ],
)
def test_a_report_of_the_start(report: SelfReport, starting: bool) -> None:
    error = explain_status("/dev/x", "MD", "10", report)
    assert isinstance(error, StartingUp) is starting
    assert isinstance(error, NotReady)
    assert not isinstance(explain_status("/dev/x", "MD", "0L", report), StartingUp)


def test_errors_of_the_line_are_not_the_sensors() -> None:
    report = SelfReport("001 Booting", "Trouble")
    damaged = DataInvalid("/dev/x", "a frame was dropped")
    assert report.added_to(damaged) is damaged
    assert isinstance(report.added_to(DeviceFault("/dev/x", "silent")), StartingUp)
    assert isinstance(report.added_to(AbnormalState("/dev/x", "0L")), AbnormalState)
