"""The contract of wheel odometry: the cumulative pose of the base in a frame that drifts but does not jump."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class RawOdometry:
    """A cumulative odometry reading.

    Attributes:
        t_rx: ``t_mono`` of arrival (kernel receive stamp where there is one).
        t_mono: ``t_mono`` at which the pose was true; for a sender without a shared clock: ``t_rx`` less the network's
            hold-up.
        x, y: metres. yaw: rad, counter-clockwise, not necessarily wrapped.
        missed: readings lost in transit since the previous one; not recorded.
    """

    t_rx: float
    t_mono: float
    x: float
    y: float
    yaw: float
    missed: int = 0


class OdometrySource(Protocol):
    """A source of odometry: a UDP listener, a Modbus write, a log."""

    async def run(self, on_odometry: Callable[[RawOdometry], None]) -> None:
        """Deliver readings from the loop thread until cancelled or exhausted."""
        ...
