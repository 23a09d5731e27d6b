"""Real devices by their names: serial ports, network sensors, I2C buses.

Drivers get an opener injected; these are the ones the daemon injects. Each kind's module is imported when a device of
that kind is opened, so that nobody pays for a library of a kind he does not have.
"""

from __future__ import annotations

from collections.abc import Callable

from hal.bus.i2c import AsyncBus, Bus
from hal.errors import DeviceRefused
from hal.port.port import Port


async def open_port(device: str, baud: int) -> Port:
    """Open a real device: the :class:`PortOpener` of the daemon.

    Args:
        device: path of a serial port (``/dev/ttyACM0``) or ``tcp://host:port`` (SCIP: port 10940, the default).
        baud: line rate in bit/s; without meaning on USB CDC and TCP.

    Raises:
        DeviceMissing: no such path, unplugged, host unreachable.
        DeviceRefused: permission, busy, not a serial port, or a name of neither kind.
    """
    if device.startswith("tcp://"):
        from hal.port.tcp_port import open_tcp_port

        return await open_tcp_port(device)
    if device.startswith("/"):
        from hal.port.serial_port import open_serial_port

        return await open_serial_port(device, baud)
    raise DeviceRefused(device, "not a device name", "expected a path such as /dev/ttyACM0, or tcp://host:port")


def blocking_opener(name: str) -> Callable[[str], Bus]:
    """What opens a bus of this kind of name, blocking; its module is imported only now.

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
