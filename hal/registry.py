"""Registry of lidar drivers by name: imported when used, extended by entry points of installed packages.

A device string is ``auto``, a path, ``tcp://host:port``, or ``name:rest``, where ``name`` is a registered driver and
``rest`` is its own to understand. Strings without a registered name belong to the HOKUYO driver.

A package adds a driver with an entry point in the group ``lumiloop.lidar``; it names a callable like
:class:`LidarFactory`.
"""

from __future__ import annotations

import importlib
from importlib.metadata import entry_points
from typing import Final, Protocol, cast

from hal.clock import Clock
from hal.errors import DeviceRefused
from hal.lidar import Lidar
from hal.port.port import PortOpener

DEFAULT: Final = "hokuyo"
GROUP: Final = "lumiloop.lidar"
_BUILT_IN: Final = {"hokuyo": "hal.hokuyo.driver:HokuyoDriver"}


class LidarFactory(Protocol):
    """A constructor of a driver; arguments as of :class:`hal.hokuyo.driver.HokuyoDriver`."""

    def __call__(
        self, device: str, *, clock: Clock, opener: PortOpener, serial: str, baud: int, intensity: bool
    ) -> Lidar:
        """Make a driver; nothing is opened yet. Raises `ValueError` for options the driver does not support."""
        ...


def names() -> list[str]:
    """Names of the registered drivers, built in and installed."""
    return sorted({*_BUILT_IN, *(point.name for point in entry_points(group=GROUP))})


def split(device: str) -> tuple[str, str]:
    """Split a device string into the driver's name and the rest: ``("hokuyo", "/dev/ttyACM0")``."""
    name, colon, rest = device.partition(":")
    if colon and not rest.startswith("//") and name in names():
        return name, rest
    return DEFAULT, device


def lidar_factory(name: str) -> LidarFactory:
    """The driver called ``name``.

    Raises:
        DeviceRefused: no such driver, or its package cannot be imported.
    """
    if name in _BUILT_IN:
        module, _, attribute = _BUILT_IN[name].partition(":")
        return cast(LidarFactory, getattr(importlib.import_module(module), attribute))
    for point in entry_points(group=GROUP):
        if point.name == name:
            try:
                return cast(LidarFactory, point.load())
            except (ImportError, AttributeError) as error:
                raise DeviceRefused(name, f"its package cannot be loaded: {error}", "reinstall it") from error
    raise DeviceRefused(name, "no such lidar driver", f"available: {', '.join(names())}")
