"""The fake lidar on memory ports: bytes inside one event loop, in virtual or real time."""

from __future__ import annotations

from hal.clock import Clock
from hal.errors import DeviceMissing, DeviceRefused, HalError
from hal.fake.lidar.device import FakeHokuyo
from hal.port.port import MemoryPort, Port, memory_pair


class MemoryHost:
    """The sensor's end of a memory port."""

    def __init__(self, port: MemoryPort, device: FakeHokuyo) -> None:
        self._port, self._device = port, device
        self.open = True
        device.attach(self)
        port.start(lambda data, _t: device.receive(data), self._lost)

    def accept(self, data: bytes) -> bool:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        try:
            self._port.write(data)
        except DeviceMissing:  # the host has just closed; `_lost` follows in the next turn of the loop
            return False
        return True

    def baud(self) -> int:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        return self._port.peer_baud

    def hang_up(self) -> None:
        """See :class:`hal.fake.lidar.output_line.HostEnd`."""
        if self.open:
            self.open = False
            self._device.detach()
            self._port.close()

    def _lost(self, _error: HalError) -> None:
        if self.open:
            self.open = False
            self._device.detach()


class FakeOpener:
    """A :class:`hal.port.port.PortOpener` under which fake devices are plugged in by name.

    Args:
        clock: gives arrival times; a :class:`hal.clock.LoopClock` in virtual time.
    """

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._devices: dict[str, FakeHokuyo] = {}
        self._hosts: dict[str, MemoryHost] = {}
        self.opened = 0

    def plug(self, name: str, device: FakeHokuyo) -> None:
        """Make ``device`` openable as ``name``."""
        self._devices[name] = device

    def unplug(self, name: str) -> None:
        """Remove the device; an open port to it is lost."""
        del self._devices[name]
        if name in self._hosts:
            self._hosts.pop(name).hang_up()

    async def __call__(self, device: str, baud: int) -> Port:
        """Open a plugged-in device.

        Raises:
            DeviceMissing: no device of that name, or it has no power.
            DeviceRefused: already open.
        """
        fake = self._devices.get(device)
        if fake is None or not fake.reachable:
            there = ", ".join(sorted(name for name, d in self._devices.items() if d.reachable)) or "nothing"
            raise DeviceMissing(device, "no such device", f"plugged in: {there}")
        held = self._hosts.get(device)
        if held is not None and held.open:
            raise DeviceRefused(device, "already open", "one client at a time")
        ours, theirs = memory_pair(self._clock, device)
        theirs.set_baud(baud)
        self._hosts[device] = MemoryHost(ours, fake)
        self.opened += 1
        return theirs
