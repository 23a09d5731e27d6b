"""Opens an I2C bus by its name: a device node, an adapter's own name, or a bus server's address.

A driver receives its opener as an argument; the daemon passes :func:`open_bus`. The module of each kind of bus is
imported when a bus of that kind is opened. A robot with a local bus loads no code for remote buses.
"""

from __future__ import annotations

from collections.abc import Callable

from hal.bus.i2c import AsyncBus, Bus
from hal.errors import DeviceRefused


def blocking_opener(name: str) -> Callable[[str], Bus]:
    """Return the function that opens a bus of this kind of name and blocks meanwhile.

    Raises:
        DeviceRefused: a name of no kind.
    """
    if name.startswith(("unix:", "tcp://")):
        from hal.bus.i2c_remote import open_remote

        return open_remote
    if name.startswith(("/", "adapter:")):
        from hal.bus.i2c_linux import open_linux

        return open_linux
    raise DeviceRefused(
        name,
        "not the name of an I2C bus",
        "expected a path such as /dev/i2c-1, adapter:NAME, unix:/path, or tcp://host:port",
    )


async def open_bus(name: str) -> AsyncBus:
    """Open a real or a remote bus, with a thread of its own: the :class:`BusOpener` of the daemon.

    Args:
        name: path of a device node (``/dev/i2c-1``, or a link to one), ``adapter:NAME`` for the only adapter whose
            own name contains NAME (bus numbers of USB adapters change), ``unix:/path`` or ``tcp://host:port`` for a
            bus served by :mod:`hal.bus.i2c_server`.

    Raises:
        DeviceMissing: no such bus, unplugged, host unreachable.
        DeviceRefused: permission, busy, not an I2C bus, or a name of no kind.
    """
    from hal.bus.i2c_thread import open_threaded

    return await open_threaded(name, blocking_opener(name))
