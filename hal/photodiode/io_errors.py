"""Failed I2C transactions by errno: kind of error, message, remedy, retries."""

from __future__ import annotations

import errno
import os
from dataclasses import dataclass
from typing import Final

from hal.adc import BusStuck, ChipMissing
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError


@dataclass(frozen=True, slots=True)
class Policy:
    """Response to one errno.

    Attributes:
        kind: class of the error. problem: with ``{chip}`` and ``{address}``. remedy: what a person can do.
        retries: on the open bus, before it is reopened. pause_s: before each retry.
        send_stop: precede the retry with a 2-byte read, which sends a STOP and is discarded.
    """

    kind: type[HalError]
    problem: str
    remedy: str
    retries: int = 0
    pause_s: float = 0.0
    send_stop: bool = False


_ABSENT: Final = Policy(
    ChipMissing,
    "no {chip} answers at address {address}",
    "check its power and wiring, and the address with: i2cdetect -y N",
    retries=3,
    pause_s=0.01,
)
_UNPLUGGED: Final = Policy(
    DeviceMissing, "the adapter was removed", "connect it or start its server again; the daemon reopens it"
)
_NOT_ALLOWED: Final = Policy(DeviceRefused, "permission denied", "add the user to group i2c and log in again")
_TOO_MUCH: Final = Policy(
    DeviceRefused, "the adapter does not support these reads", "use an I2C controller of the processor"
)

POLICIES: Final[dict[int, Policy]] = {
    errno.ENXIO: _ABSENT,
    errno.EREMOTEIO: _ABSENT,
    errno.ETIMEDOUT: Policy(
        BusStuck,
        "the bus is stuck (a transaction timed out)",
        "switch the converter's power off and on; check whether SDA or SCL is held low",
        retries=2,
        pause_s=0.01,
        send_stop=True,
    ),
    errno.EIO: Policy(
        DeviceFault,
        "transactions fail (EIO)",
        "check wiring, pull-ups and cable length; read the kernel log",
        retries=2,
        pause_s=0.01,
        send_stop=True,
    ),
    errno.EAGAIN: Policy(
        DeviceFault,
        "arbitration on the bus is lost repeatedly",
        "check for noise on SDA and SCL, and for a second master",
        retries=10,
    ),
    errno.EBUSY: Policy(
        DeviceRefused,
        "address {address} is in use by another lumiloop or program, or by a kernel driver",
        "end the other program (fuser -v /dev/i2c-N, systemctl status lumiloop), or unbind the driver",
        retries=3,  # `lumiloop probe` holds an address for some 10 ms
        pause_s=0.05,
    ),
    errno.EOPNOTSUPP: _TOO_MUCH,
    errno.EINVAL: _TOO_MUCH,
    errno.ENODEV: _UNPLUGGED,
    errno.ESHUTDOWN: _UNPLUGGED,
    errno.ENOENT: _UNPLUGGED,
    errno.EACCES: _NOT_ALLOWED,
    errno.EPERM: _NOT_ALLOWED,
    errno.EPROTO: Policy(
        DeviceFault, "the adapter's protocol has failed (EPROTO)", "disconnect the adapter and connect it again"
    ),
}


def policy_for(error: OSError) -> Policy:
    """The response to an error; an unlisted one reopens the bus."""
    number = error.errno or 0
    unknown = Policy(DeviceFault, f"unexpected error: {os.strerror(number)}", "read the kernel log: dmesg | tail")
    return POLICIES.get(number, unknown)


def explain(error: OSError, bus: str, chip: str, address: int) -> HalError:
    """Convert a transaction's error to a kind of :mod:`hal.errors`; a bus's own text replaces the problem."""
    policy = policy_for(error)
    problem = policy.problem.format(chip=chip, address=f"{address:#04x}")
    if error.strerror and error.strerror != os.strerror(error.errno or 0):
        problem = error.strerror
    return policy.kind(bus, problem, policy.remedy)
