"""A HOKUYO lidar without the lidar: the state machine, clock, motor and dialect of a SCIP sensor, true on the wire.

The device knows no transport: bytes come in through :meth:`FakeHokuyo.receive` and leave through the host end that is
attached to it (see :mod:`hal.fake.transport`). All time is the event loop's, so the same object runs in real time on a
pty and in virtual time on a memory port. Two runs with the same unit, source, orders and commands give the same bytes.

What it does not model: the optics (the scan source does, or does not); a motor that speeds up and slows down
gradually; clock drift that changes with temperature; USB frames of 1 ms and TCP segments; framing errors at a wrong
baud rate (noise stands for them); what sensitivity (HS) does to ranges; measuring in SCIP 1.1;
the I/O commands GF GG MF MG, DB, $IP and the microsecond stamps of HPTS firmware; ``%ST`` codes of unstable states.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from hal.fake.faults.orders import Fault, FaultError, Vocabulary
from hal.fake.faults.schedule import Orders
from hal.fake.lidar.console import Console
from hal.fake.lidar.device_state import Core
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.faults import LIDAR
from hal.fake.lidar.measuring_head import Head
from hal.fake.lidar.models import LidarModel, Unit
from hal.fake.lidar.output_line import HostEnd, OutletCounts
from hal.fake.lidar.rotor import EvenRotor, Rotor
from hal.fake.lidar.scan import ScanSource
from hal.fake.lidar.sensor_clock import SensorClock

LINK_UP = 0.5
"""Share of the start-up after which a USB or Ethernet sensor can be opened again."""


Effect = Callable[[Fault], None]


def _nothing(_fault: Fault) -> None:
    """The end of a fault that leaves nothing to be undone."""


class FakeHokuyo:
    """One simulated sensor; a :class:`hal.fake.faults.schedule.Target` of fault orders.

    Args:
        model: which type.
        source: where scans come from, see :data:`hal.fake.lidar.scan.ScanSource`.
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
        self._core = Core(model, self.unit, loop or asyncio.get_running_loop())
        self._head = Head(self._core, source, rotor or EvenRotor(self._core.now(), model.true_period_s))
        self._console = Console(self._core, self._head, self._reboot)
        self._reachable = self._link_up = True
        self._watchers: list[Callable[[bool], None]] = []
        if not self.unit.booted:
            self.power_on()
        elif self.unit.scip1:
            self._core.state = State.SCIP1

    # what can be seen from outside

    @property
    def state(self) -> State:
        """Where the sensor stands."""
        return self._core.state

    @property
    def laser(self) -> bool:
        """True while the laser is on."""
        return self._core.laser

    @property
    def clock(self) -> SensorClock:
        """The sensor's own clock."""
        return self._core.clock

    @property
    def rotor(self) -> Rotor:
        """When revolutions begin, and how long they take."""
        return self._head.rotor

    @property
    def baud(self) -> int:
        """The rate an RS-232 sensor talks at now."""
        return self._core.baud

    @property
    def scans_sent(self) -> int:
        """Scans of streams that were encoded, whatever became of them afterwards."""
        return self._head.scans_sent

    @property
    def counts(self) -> OutletCounts:
        """What became of the replies."""
        return self._core.outlet.counts

    @property
    def orders(self) -> Orders:
        """The faults in force, and how often each word has struck."""
        return self._core.orders

    @property
    def vocabulary(self) -> Vocabulary:
        """The words in which faults are ordered."""
        return LIDAR

    @property
    def reachable(self) -> bool:
        """False while the connection cannot be opened: plug pulled, no power, USB or network not up yet."""
        return self._reachable

    @property
    def attached(self) -> bool:
        """True while a host has the line open."""
        return self._core.outlet.host is not None

    def watch(self, changed: Callable[[bool], None]) -> None:
        """Transports ask to be told when :attr:`reachable` changes."""
        self._watchers.append(changed)

    # connection and power

    def attach(self, host: HostEnd) -> None:
        """A host has opened the line."""
        self._core.outlet.host = host

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        if not self._core.orders.on("off"):
            self._console.receive(data)

    def detach(self) -> None:
        """The host has gone. A network sensor stops; any other goes on talking to nobody."""
        self._core.outlet.host = None
        if self.model.link == "ethernet":
            self._console.forget()
            self._core.outlet.clear()
            if self.state in (State.MULTI, State.SINGLE, State.TIME_ADJUST):
                self._head.halt()
                self._core.dark(State.IDLE)

    def power_on(self, keep_link: bool = False) -> None:
        """Start up: clock at zero, BOOTING, then IDLE (or SCIP 1.1); USB and Ethernet drop the connection meanwhile."""
        core = self._core
        self._power_off()
        late = core.orders.on("boot_delay")
        boot_s = self.model.boot_s + (late.number("by_s") if late else 0.0)
        core.ready_at = core.now() + max(self.unit.spin_up_s, boot_s)
        core.at("boot", core.now() + boot_s, self._booted)
        if self.model.link != "rs232" and not keep_link:
            self._set_link(False)
            core.at("link", core.now() + boot_s * LINK_UP, lambda: self._set_link(True))

    def close(self) -> None:
        """Cancel every timer; the object is of no use afterwards."""
        self._core.cancel_all()
        self._core.outlet.host = None
        self._core.outlet.clear()

    def _power_off(self) -> None:
        core = self._core
        core.cancel_all()
        self._console.forget()
        self._head.halt()
        core.dark(State.BOOTING)
        core.outlet.clear()
        core.clock.set(core.now())
        core.use_baud(self.unit.baud)
        core.trouble = ""
        if self._head.slower_percent:
            self._head.turn(slower_percent=0)

    def _booted(self) -> None:
        scip1 = self.unit.scip1 or self._core.orders.on("scip1")
        self._core.state = State.SCIP1 if scip1 else State.IDLE

    def _reboot(self) -> None:
        self.power_on()

    def _set_link(self, up: bool) -> None:
        """The connection is there or not; transports are told when it can be opened now, or no longer."""
        self._link_up = up
        reachable = up and self._core.orders.on("hangup") is None
        if reachable != self._reachable:
            self._reachable = reachable
            host = self._core.outlet.host
            if not reachable and host is not None:
                host.hang_up()
            for changed in self._watchers:
                changed(reachable)

    # fault orders

    def in_force(self) -> list[Fault]:
        """Faults that have not been lifted and have not spent their strikes."""
        return self._core.orders.in_force()

    def check(self, fault: Fault) -> None:
        """Refuse an order that makes no sense for this sensor.

        Raises:
            FaultError: ``baud`` at a sensor without a serial line.
        """
        if fault.what == "baud" and self.model.link != "rs232":
            raise FaultError("baud", f"this {self.model.modl} is wired by {self.model.link}, it has no line rate")

    def begin(self, fault: Fault) -> None:
        """A fault comes into force (one that happens once happens now)."""
        if LIDAR[fault.what].kind != "once":
            self._core.orders.add(fault)
        begin = self._effects().get(fault.what)
        if begin is not None:
            begin[0](fault)

    def end(self, fault: Fault) -> None:
        """A fault is lifted."""
        self._core.orders.remove(fault)
        effects = self._effects().get(fault.what)
        if effects is not None:
            other = self._core.orders.on(fault.what)  # the same was ordered twice
            effects[1](fault) if other is None else effects[0](other)

    def _effects(self) -> dict[str, tuple[Effect, Effect]]:
        """What the words do at their beginning and at their end, beyond being in force."""
        core = self._core
        return {
            "off": (self._turn_off, lambda _: self.power_on()),
            "hangup": (lambda _: self._set_link(self._link_up), lambda _: self._set_link(self._link_up)),
            "slow": (
                lambda f: self._head.turn(slow_factor=f.number("factor")),
                lambda _: self._head.turn(slow_factor=1.0),
            ),
            "stall": (lambda _: core.outlet.hold(True), lambda _: core.outlet.hold(False)),
            "chunks": (self._chunk, lambda _: core.outlet.rewrap()),
            "verify": (self._verify, lambda _: self._verified()),
            "baud": (lambda f: core.use_baud(int(f.number("rate"))), _nothing),
            "inject": (lambda f: self.receive(f.text("text").encode("latin-1")), _nothing),
            "reset": (lambda _: None if core.orders.on("off") else self.power_on(keep_link=True), _nothing),
            "scip1": (lambda _: self._fall_back(), _nothing),
            "set_clock": (lambda f: core.clock.set(core.now(), f.number("ms")), _nothing),
            "error": (self._fail, _nothing),
        }

    def _turn_off(self, _fault: Fault) -> None:
        self._power_off()
        if self.model.link != "rs232":
            self._set_link(False)

    def _chunk(self, fault: Fault) -> None:
        split_end = bool(fault.values["split_end"])
        self._core.outlet.rewrap(int(fault.number("piece")), split_end, int(fault.number("join")))

    def _verify(self, _fault: Fault) -> None:
        self._head.report("21")
        self._head.pause()

    def _verified(self) -> None:
        self._head.report("98")
        self._head.resume()

    def _fall_back(self) -> None:
        if self.state is not State.BOOTING:
            self._head.halt()
            self._core.dark(State.SCIP1)

    def _fail(self, fault: Fault) -> None:
        code = f"{int(fault.number('code')):02d}"
        self._head.report(code)
        self._head.halt()
        self._core.dark(State.ERROR)
        self._core.trouble = f"Trouble!! Error No. =[00->{code}]"
