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
    """Who takes what comes in.

    ``on_save`` is asked to save the map, ``on_dump`` to write the flight recorder, ``on_switch`` to go on in another
    map; each tells the end of it: empty, or why it came to nothing. What is None is refused. ``on_loop_seen``: how many
    loops a client has seen.
    """

    on_odometry: OnOdometry
    on_imu: Callable[[RawImu], None]
    on_command: Callable[[Command], None]
    on_save: Callable[[OnDone], None]
    on_dump: Callable[[OnDone], None] | None = None
    on_switch: Callable[[int, OnDone], None] | None = None
    on_loop_seen: Callable[[int], None] = lambda _: None
