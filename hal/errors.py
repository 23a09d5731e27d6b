"""Four nouns for everything that can go wrong at a device, each with a written policy.

========================  =======================  ==================================================
error                     example                  what the daemon does
========================  =======================  ==================================================
:class:`DeviceMissing`    no /dev/ttyACM0          keep trying with back-off; state names the device
:class:`DeviceRefused`    permission, busy port    keep trying slowly; a person has to act, say how
:class:`DeviceFault`      sensor reports an error  recover (reset, reboot), then keep trying
:class:`DataInvalid`      checksum, wrong length   drop that datum, count it, go on
========================  =======================  ==================================================
"""

from __future__ import annotations

from typing import Final

KEPT_AWAY: Final = "not permitted", "the service's unit allows no such device: systemctl edit it, DeviceAllow="
"""Problem and remedy of EPERM: rights to the file are there (else EACCES), and something above them says no."""


class HalError(Exception):
    """Base of all device errors.

    Args:
        device: the thing as the user named it (``/dev/ttyACM0``, ``tcp://192.168.0.10:10940``).
        problem: what is wrong, in one clause.
        remedy: what a person can do about it, in one clause; empty when nothing is to be done.
    """

    def __init__(self, device: str, problem: str, remedy: str = "") -> None:
        super().__init__(device, problem, remedy)
        self.device = device
        self.problem = problem
        self.remedy = remedy

    def __str__(self) -> str:
        text = f"{self.device}: {self.problem}"
        return f"{text} ({self.remedy})" if self.remedy else text


class DeviceMissing(HalError):
    """The device is not there (not plugged in, unplugged, host unreachable). Policy: retry with back-off."""


class DeviceRefused(HalError):
    """The device is there but not for us (permission, busy, another kind). Policy: retry slowly, ask a person."""


class DeviceFault(HalError):
    """The device answers and says that it is broken, or has gone silent. Policy: recovery ladder, then retry."""


class DataInvalid(HalError):
    """Bytes that are not what the protocol allows. Policy: drop, count, go on."""
