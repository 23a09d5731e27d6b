"""The four kinds of device error, each with the daemon's policy.

========================  =======================  ==================================================
error                     example                  what the daemon does
========================  =======================  ==================================================
:class:`DeviceMissing`    no /dev/ttyACM0          keep trying with back-off; state names the device
:class:`DeviceRefused`    permission, busy port    keep trying slowly; name what a person must do
:class:`DeviceFault`      sensor reports an error  recover (reset, reboot), then keep trying
:class:`DataInvalid`      checksum, wrong length   drop that datum, count it, go on
========================  =======================  ==================================================
"""

from __future__ import annotations

from typing import Final

KEPT_AWAY: Final = (
    "not permitted",
    ("the service unit denies this device; allow it with `systemctl edit` and DeviceAllow="),
)
"""Problem and remedy of EPERM: the file's permissions allow the access (else EACCES), the service unit denies it."""


class HalError(Exception):
    """Base of all device errors.

    Args:
        device: the device as the user named it (``/dev/ttyACM0``, ``tcp://192.168.0.10:10940``).
        problem: what is wrong, in one clause.
        remedy: what a person can do about it, in one clause; empty where nothing can be done.
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
    """The device is absent (not plugged in, unplugged, host unreachable). Policy: retry with back-off."""


class DeviceRefused(HalError):
    """The device is present but unusable (permission, busy, another kind). Policy: retry slowly, name the remedy."""


class DeviceFault(HalError):
    """The device reports an error or has stopped answering. Policy: escalating recovery, then retry."""


class DataInvalid(HalError):
    """Bytes that violate the protocol. Policy: drop, count, go on."""
