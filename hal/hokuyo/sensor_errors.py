"""The errors that a sensor states itself: refusals by status, and the state that ``II`` reports.

Sources: SCIP 2.0 C-42-03320B section 5; SCIP 2.2 C-42-04076 (0L, 0M, ``MESM 001 Booting``).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from hal.errors import DataInvalid, DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.hokuyo import scip

POWER_CYCLE: Final = "switch its power off and on"
_TRIED_AGAIN: Final = "the daemon tries again automatically"
_HEALTHY: Final = re.compile(r"works? well|no error|normal", re.IGNORECASE)
_STARTING: Final = re.compile(r"\b(boot|start|warm|wak|initiali|spin)", re.IGNORECASE)
_FAILED: Final = re.compile(r"trouble|(?<!no )error|fail|abnormal", re.IGNORECASE)


class AbnormalState(DeviceFault):
    """The sensor answers 0L: it accepts RB only."""


class NotReady(DeviceFault):
    """The sensor answers, but does not measure at present: it starts up, or is in another mode."""


class StartingUp(NotReady):
    """The sensor reports that it is starting up; a reset would only prolong that."""


@dataclass(frozen=True, slots=True)
class SelfReport:
    """What a sensor reports of itself in ``II``: text of its mode (MESM) and of its health (STAT)."""

    mode: str = ""
    health: str = ""

    @classmethod
    def of(cls, lines: dict[str, str]) -> SelfReport:
        """The report in the text lines of II."""
        return cls(lines.get("MESM", ""), lines.get("STAT", ""))

    @property
    def starting(self) -> str:
        """The text by which the sensor reports that it is starting up; empty where it does not."""
        said = (text for text in (self.mode, self.health) if _STARTING.search(text) and not _FAILED.search(text))
        return next(said, "")

    @property
    def trouble(self) -> str:
        """The health text where it is none of the known healthy ones; empty otherwise."""
        return "" if _HEALTHY.search(self.health) and not _abnormal(self.health) else self.health

    def added_to(self, error: HalError) -> HalError:
        """The error with the sensor's own report; errors of the line or of the configuration stay as they are."""
        if isinstance(error, (DataInvalid, DeviceMissing, DeviceRefused)):
            return error
        if self.starting and not isinstance(error, AbnormalState):
            return StartingUp(error.device, _joined(error.problem, self.starting), _TRIED_AGAIN)
        return type(error)(error.device, _joined(error.problem, self.trouble), error.remedy)


def _abnormal(health: str) -> bool:
    return bool(re.search(r"abnormal|unstable", health, re.IGNORECASE))


def _joined(problem: str, report: str) -> str:
    return f"{problem}; the sensor reports: {report}" if report and report not in problem else problem


def explain_status(device: str, command: str, status: str, report: SelfReport = SelfReport()) -> HalError:
    """The error for a refusal or a mid-stream status, with the sensor's own report."""
    return report.added_to(_by_status(device, f"{command} answers {status}", status))


def _by_status(device: str, text: str, status: str) -> HalError:
    number = int(status) if status.isdigit() else -1
    if status == scip.ABNORMAL:
        return AbnormalState(device, f"{text}: error state", POWER_CYCLE)
    if status in scip.NOT_NOW:
        return NotReady(device, f"{text}: not now (starting up, or in another mode)", _TRIED_AGAIN)
    if 50 <= number <= 97:
        return DeviceFault(
            device,
            f"{text}: hardware fault (light source, motor)",
            f"{POWER_CYCLE}; if it persists, have the sensor repaired",
        )
    if 21 <= number <= 49:
        return DeviceFault(device, f"{text}: the sensor runs a self-test", POWER_CYCLE)
    if 1 <= number <= 7:
        return DeviceRefused(device, f"{text}: the sensor rejects the range that it states", "report the model")
    return DeviceFault(device, text, POWER_CYCLE)
