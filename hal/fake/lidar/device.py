"""The fake HOKUYO lidar: state machine, clock, motor and dialect of a SCIP sensor, exact on the wire.

Bytes come in through :meth:`FakeHokuyo.receive` and leave through the attached host end (see
:mod:`hal.fake.transport`). All time is the event loop's: the same object runs in real time on a pty and in virtual time
on a memory port. Two runs with the same unit, source, orders and commands give the same bytes.

Not modelled: the optics (left to the scan source); gradual changes of the motor's speed; clock drift with temperature;
USB frames of 1 ms and TCP segments; framing errors at a wrong baud rate (random bytes instead); the effect of
sensitivity (HS) on ranges; measuring in SCIP 1.1; the I/O commands GF GG MF MG, DB, $IP and the
microsecond stamps of HPTS firmware; ``%ST`` codes of unstable states.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from hal.fake.faults.orders import Fault, FaultError, Vocabulary
from hal.fake.faults.schedule import ActiveFaults
from hal.fake.lidar.console import Console
from hal.fake.lidar.device_state import DeviceState
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.measuring_head import MeasuringHead
from hal.fake.lidar.models import LidarModel, Unit
from hal.fake.lidar.output_line import HostEnd, OutputCounts
from hal.fake.lidar.rotor import EvenRotor, Rotor
from hal.fake.lidar.scan import ScanSource
from hal.fake.lidar.sensor_clock import SensorClock

LINK_UP = 0.5
"""Share of the start-up after which a USB or Ethernet sensor can be opened again."""


Effect = Callable[[Fault], None]


def _nothing(_fault: Fault) -> None:
    """The end of a fault without an effect to undo."""


class FakeHokuyo:
    """One simulated sensor; a :class:`hal.fake.faults.schedule.Target` of fault orders.

    Args:
        model: the type of sensor.
        source: of the scans, see :data:`hal.fake.lidar.scan.ScanSource`.
        unit: serial number, clock error and the like.
        rotor: instants of the revolutions; default the model's motor, first revolution now.
        loop: the clock and timers; default the running loop.
    """

    def __init__(
        self,
        model: LidarModel,
        source: ScanSource,
        *,
        unit: Unit | None = None,
        rotor: Rotor | None = None,
        loop: asyncio.AbstractEventLoop | None = None,
    ) -> None:
        self.model = model
        self.unit = unit or Unit()
        self._device = DeviceState(model, self.unit, loop or asyncio.get_running_loop())
        self._head = MeasuringHead(self._device, source, rotor or EvenRotor(self._device.now(), model.true_period_s))
        self._console = Console(self._device, self._head, self._reboot)
        self._reachable = self._link_up = True
        self._watchers: list[Callable[[bool], None]] = []
        if not self.unit.booted:
            self.power_on()
        elif self.unit.scip1:
            self._device.state = State.SCIP1

    # public state

    @property
    def state(self) -> State:
        """State of the sensor."""
        return self._device.state

    @property
    def laser(self) -> bool:
        """True while the laser is on."""
        return self._device.laser

    @property
    def clock(self) -> SensorClock:
        """The sensor's own clock."""
        return self._device.clock

    @property
    def rotor(self) -> Rotor:
        """Start times and periods of the revolutions."""
        return self._head.rotor

    @property
    def baud(self) -> int:
        """Present rate of an RS-232 sensor, bit/s."""
        return self._device.baud

    @property
    def scans_sent(self) -> int:
        """Encoded scans of streams, whether or not they arrived."""
        return self._head.scans_sent

    @property
    def counts(self) -> OutputCounts:
        """Counters of sent and lost replies."""
        return self._device.output.counts

    @property
    def orders(self) -> ActiveFaults:
        """The faults in force, and the number of strikes of each word."""
        return self._device.orders

    @property
    def vocabulary(self) -> Vocabulary:
        """The words of its fault orders."""
        return LIDAR

    @property
    def reachable(self) -> bool:
        """False while the connection cannot be opened: unplugged, no power, USB or network not up yet."""
        return self._reachable

    @property
    def attached(self) -> bool:
        """True while a host has the line open."""
        return self._device.output.host is not None

    def on_reachable(self, changed: Callable[[bool], None]) -> None:
        """Register a callback of a transport for changes of :attr:`reachable`."""
        self._watchers.append(changed)

    # connection and power

    def attach(self, host: HostEnd) -> None:
        """Attach the host that has opened the line."""
        self._device.output.host = host

    def receive(self, data: bytes) -> None:
        """Process bytes from the host."""
        if not self._device.orders.on("off"):
            self._console.receive(data)

    def detach(self) -> None:
        """Detach the host. A network sensor stops; any other streams on."""
        self._device.output.host = None
        if self.model.link == "ethernet":
            self._console.reset()
            self._device.output.clear()
            if self.state in (State.MULTI, State.SINGLE, State.TIME_ADJUST):
                self._head.halt()
                self._device.laser_off(State.IDLE)

    def power_on(self, keep_link: bool = False) -> None:
        """Start up: clock at zero, BOOTING, then IDLE (or SCIP 1.1); USB and Ethernet drop the connection meanwhile."""
        device = self._device
        self._power_off()
        device.started = device.now()
        late = device.orders.on("boot_delay")
        boot_s = self.model.boot_s + (late.number("by_s") if late else 0.0)
        device.ready_at = device.now() + max(self.unit.spin_up_s, boot_s)
        device.at("boot", device.now() + boot_s, self._booted)
        if self.model.link != "rs232" and not keep_link:
            self._set_link(False)
            device.at("link", device.now() + boot_s * LINK_UP, lambda: self._set_link(True))

    def close(self) -> None:
        """Cancel every timer; the object cannot be used afterwards."""
        self._device.cancel_all()
        self._device.output.host = None
        self._device.output.clear()

    def _power_off(self) -> None:
        device = self._device
        device.cancel_all()
        self._console.reset()
        self._head.halt()
        device.laser_off(State.BOOTING)
        device.output.clear()
        device.clock.set(device.now())
        device.use_baud(self.unit.baud)
        device.trouble = ""
        if self._head.slower_percent:
            self._head.turn(slower_percent=0)

    def _booted(self) -> None:
        scip1 = self.unit.scip1 or self._device.orders.on("scip1")
        self._device.state = State.SCIP1 if scip1 else State.IDLE

    def _reboot(self) -> None:
        self.power_on()

    def _set_link(self, up: bool) -> None:
        """Set the state of the connection; transports are called where :attr:`reachable` changes."""
        self._link_up = up
        reachable = up and self._device.orders.on("hangup") is None
        if reachable != self._reachable:
            self._reachable = reachable
            host = self._device.output.host
            if not reachable and host is not None:
                host.hang_up()
            for changed in self._watchers:
                changed(reachable)

    # fault orders

    def in_force(self) -> list[Fault]:
        """Faults neither lifted nor used up."""
        return self._device.orders.in_force()

    def check(self, fault: Fault) -> None:
        """Refuse an order that this sensor cannot carry out.

        Raises:
            FaultError: ``baud`` at a sensor without a serial line.
        """
        if fault.what == "baud" and self.model.link != "rs232":
            raise FaultError("baud", f"this {self.model.modl} is connected by {self.model.link} and has no line rate")

    def begin(self, fault: Fault) -> None:
        """A fault comes into force (one that happens once happens now)."""
        if LIDAR[fault.what].kind != "once":
            self._device.orders.add(fault)
        begin = self._effects().get(fault.what)
        if begin is not None:
            begin[0](fault)

    def end(self, fault: Fault) -> None:
        """A fault is lifted."""
        self._device.orders.remove(fault)
        effects = self._effects().get(fault.what)
        if effects is not None:
            other = self._device.orders.on(fault.what)  # the same fault was ordered twice
            effects[1](fault) if other is None else effects[0](other)

    def _effects(self) -> dict[str, tuple[Effect, Effect]]:
        """Effects of the words at their beginning and at their end, beyond being in force."""
        device = self._device
        return {
            "off": (self._turn_off, lambda _: self.power_on()),
            "hangup": (lambda _: self._set_link(self._link_up), lambda _: self._set_link(self._link_up)),
            "slow": (
                lambda f: self._head.turn(slow_factor=f.number("factor")),
                lambda _: self._head.turn(slow_factor=1.0),
            ),
            "stall": (lambda _: device.output.hold(True), lambda _: device.output.hold(False)),
            "chunks": (self._chunk, lambda _: device.output.rewrap()),
            "verify": (self._verify, lambda _: self._verified()),
            "baud": (lambda f: device.use_baud(int(f.number("rate"))), _nothing),
            "inject": (lambda f: self.receive(f.text("text").encode("latin-1")), _nothing),
            "reset": (lambda _: None if device.orders.on("off") else self.power_on(keep_link=True), _nothing),
            "scip1": (lambda _: self._fall_back(), _nothing),
            "set_clock": (lambda f: device.clock.set(device.now(), f.number("ms")), _nothing),
            "error": (self._fail, _nothing),
            "not_ready": (self._start_late, _nothing),
        }

    def _turn_off(self, _fault: Fault) -> None:
        self._power_off()
        if self.model.link != "rs232":
            self._set_link(False)

    def _chunk(self, fault: Fault) -> None:
        split_end = bool(fault.values["split_end"])
        self._device.output.rewrap(int(fault.number("piece")), split_end, int(fault.number("join")))

    def _verify(self, _fault: Fault) -> None:
        self._head.report("21")
        self._head.pause()

    def _verified(self) -> None:
        self._head.report("98")
        self._head.resume()

    def _start_late(self, _fault: Fault) -> None:
        """The sensor has started just now."""
        self._device.started = self._device.now()

    def _fall_back(self) -> None:
        if self.state is not State.BOOTING:
            self._head.halt()
            self._device.laser_off(State.SCIP1)

    def _fail(self, fault: Fault) -> None:
        code = f"{int(fault.number('code')):02d}"
        self._head.report(code)
        self._head.halt()
        self._device.laser_off(State.ERROR)
        self._device.trouble = f"Trouble!! Error No. =[00->{code}]"
