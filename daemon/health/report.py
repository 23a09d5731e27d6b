"""Published health of the daemon: present faults, restarts by component, components down, hanging threads, uptime."""

from __future__ import annotations

from typing import Final

from daemon.health.faults import Fault
from daemon.health.present_faults import PresentFaults
from daemon.health.supervisor import Supervisor
from daemon.health.thread_watch import ThreadWatch
from daemon.snapshot import Condition, Part
from hal.adc import AdcStatus
from hal.clock import Clock
from hal.lidar import LidarStatus

NAMES: Final = {
    "lidar": Part.LIDAR,
    "photodiode": Part.PHOTODIODE,
    "odometry": Part.ODOMETRY,
    "imu": Part.IMU,
    "modbus": Part.MODBUS,
    "modbus serial": Part.RTU,
    "pose": Part.POSE,
    "pose subscriptions": Part.SUBSCRIPTIONS,
    "stream": Part.STREAM,
    "map": Part.MAP,
}
"""Components by their name in the supervisor; every other name is OTHER."""


class Reporter:
    """Builds the health record once a second and when the faults change; between these it returns the same object.

    Args:
        clock: of the daemon. supervisor: restarts of components. threads: hang detection. faults: those present.
        drivers: status of lidar and converter; None: not fitted.
    """

    def __init__(
        self,
        clock: Clock,
        supervisor: Supervisor,
        threads: ThreadWatch,
        faults: PresentFaults,
        drivers: tuple[LidarStatus, AdcStatus | None],
    ) -> None:
        self._clock, self._supervisor, self._threads, self._faults = clock, supervisor, threads, faults
        self._lidar, self._adc = drivers
        self._begun = clock.now()
        self._shown: tuple[int, tuple[Fault, ...], Condition] | None = None

    def __call__(self) -> Condition:
        """The present health record."""
        second, faults = int(self._clock.now() - self._begun), self._faults.faults
        shown = self._shown
        if shown is None or shown[0] != second or shown[1] is not faults:
            shown = self._shown = second, faults, self._made(second, faults)
        return shown[2]

    def _made(self, second: int, faults: tuple[Fault, ...]) -> Condition:
        restarts = dict.fromkeys(Part, 0)
        for name, count in self._supervisor.restarts.items():
            restarts[NAMES.get(name, Part.OTHER)] += count
        restarts[Part.LIDAR] += self._lidar.reconnects + self._lidar.resyncs
        restarts[Part.PHOTODIODE] += 0 if self._adc is None else self._adc.recoveries
        return Condition(
            uptime_s=second,
            faults=tuple(int(fault) for fault in faults),
            restarts=tuple(restarts[part] for part in Part),
            down=frozenset(NAMES.get(name, Part.OTHER) for name in self._supervisor.failed),
            hanging=self._threads.hanging,
        )
