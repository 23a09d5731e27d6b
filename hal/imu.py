"""The contract of a yaw gyro: readings in rad/s."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol


@dataclass(frozen=True, slots=True)
class RawImu:
    """One gyro reading: ``yaw_rate`` in rad/s, counter-clockwise, true at ``t_mono``."""

    t_rx: float
    t_mono: float
    yaw_rate: float


class ImuSource(Protocol):
    """A source of gyro readings: a UDP listener, a log."""

    async def run(self, on_imu: Callable[[RawImu], None]) -> None:
        """Deliver readings from the loop thread until cancelled or exhausted."""
        ...
