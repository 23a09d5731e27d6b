"""Causes of faults: which present faults follow from another present one.

The rule needs the present faults alone. So every reader of a list of faults can group it, also from registers.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Final

from daemon.health.faults import Fault

_LATE: Final = frozenset(
    (Fault.LIDAR_GAPS, Fault.LIDAR_LATE, Fault.ADC_STALLS, Fault.ADC_GAPS, Fault.ODOMETRY_GAPS),
)
"""Faults of input that the process does not receive in time."""

CONSEQUENCES: Final[dict[Fault, frozenset[Fault]]] = {
    Fault.COMPUTER_SLOW: _LATE | {Fault.LOOP_STALLED, Fault.OVERRUNS, Fault.OVERLOADED},
    Fault.LOOP_STALLED: _LATE,
    Fault.LIDAR_TURNED: frozenset((Fault.ODOMETRY_DISAGREES,)),
    Fault.GYRO_SCALE: frozenset((Fault.ODOMETRY_DISAGREES,)),
    Fault.LIDAR_FROZEN: frozenset((Fault.ODOMETRY_DISAGREES, Fault.LIDAR_MISFIT)),
    Fault.ODOMETRY_SCALE: frozenset((Fault.ODOMETRY_DISAGREES,)),
    Fault.NO_DESCRIPTORS: frozenset(
        (
            *(Fault.LIDAR_MISSING, Fault.LIDAR_REFUSED, Fault.ADC_BUS_MISSING, Fault.ADC_BUS_REFUSED),
            *(Fault.PART_FAILED, Fault.PUBLISHER_FAILED, Fault.RECORDER_FAILED, Fault.MAP_NOT_SAVED),
            *(Fault.MAP_REFUSED, Fault.POSE_NOT_KEPT, Fault.FLIGHT_RECORDER_FAILED),
        )
    ),
}
"""Faults that follow from a fault while both are present. The first cause that is present counts."""


def cause_of(fault: int, present: Collection[int]) -> int:
    """Number of the present fault that this one follows from, 0 where it stands for itself."""
    return next((int(cause) for cause, all_of_it in CONSEQUENCES.items() if cause in present and fault in all_of_it), 0)


def grouped(faults: Iterable[Fault]) -> tuple[Fault, ...]:
    """Return the faults, the gravest cause first, each followed by its consequences."""
    present = frozenset(faults)

    def place(fault: Fault) -> tuple[int, bool, int]:
        cause = cause_of(fault, present)
        return cause or fault, cause > 0, fault

    return tuple(sorted(present, key=place))
