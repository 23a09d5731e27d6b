"""Opens a lidar's byte port by its device name: a serial port or a TCP connection.

A driver receives its opener as an argument; the daemon passes the one in this module. The module of each kind of port
is imported when a device of that kind is opened. A robot with a serial sensor loads no code for network sensors.
"""

from __future__ import annotations

from hal.errors import DeviceRefused
from hal.port.port import Port


async def open_port(device: str, baud: int) -> Port:
    """Open a real device: the :class:`PortOpener` of the daemon.

    Args:
        device: path of a serial port (``/dev/ttyACM0``) or ``tcp://host:port`` (SCIP: port 10940, the default).
        baud: line rate in bit/s; ignored on USB CDC and TCP.

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
