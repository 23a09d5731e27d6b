"""Callbacks for what arrives from the network: readings, commands and requests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from daemon.system.callbacks import OnDone
from estimator import Command
from hal.imu import RawImu
from hal.odometry import RawOdometry

OnOdometry = Callable[[RawOdometry], None]


@dataclass(frozen=True, slots=True)
class Feeds:
    """Receivers of network input.

    ``on_save`` saves the map, ``on_dump`` writes the flight recorder, ``on_switch`` changes to another map. Each
    reports its end: empty on success, otherwise the reason. A request whose callback is None is refused.
    ``on_loop_seen`` receives the number of loop closures that a client has acknowledged.
    """

    on_odometry: OnOdometry
    on_imu: Callable[[RawImu], None]
    on_command: Callable[[Command], None]
    on_save: Callable[[OnDone], None]
    on_dump: Callable[[OnDone], None] | None = None
    on_switch: Callable[[int, OnDone], None] | None = None
    on_loop_seen: Callable[[int], None] = lambda _: None
