"""A HOKUYO lidar without the lidar: the state machine, clock, motor and dialect of a SCIP sensor, true on the wire.

The device knows no transport: bytes come in through :meth:`FakeHokuyo.receive` and leave through the host end that is
attached to its :class:`hal.fake.outlet.Outlet` (see :mod:`hal.fake.transport`). All time is the event loop's, so the
same object runs in real time on a pty and in virtual time on a memory port.
"""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable
from random import Random

from hal.fake import scip_encoder, texts
from hal.fake.answers import State, answer
from hal.fake.commands import LINE_ENDS, STREAMS, Measure, Refusal, Request, measure, parse
from hal.fake.frames import payload
from hal.fake.models import LidarModel, Unit
from hal.fake.outlet import HostEnd, Outlet, Pacing
from hal.fake.rotor import EvenRotor, Rotor
from hal.fake.scan import FakeScan, ScanSource
from hal.fake.sensor_clock import SensorClock

log = logging.getLogger(__name__)

MAX_LINE = 256
"""Characters of a command line; what goes beyond is thrown away up to the line's end."""
REBOOT_PAIR_S = 1.0
"""Two RB must come within this time; the reboot follows this long after the second."""
BAUDS = (19200, 38400, 57600, 115200, 250000, 500000, 750000)
RATES = {"usb": 1.0e6, "ethernet": 12.5e6}
"""Bytes per second; RS-232 follows its baud rate, ten bit times a byte."""


class FakeHokuyo:
    """One simulated sensor.

    Args:
        model: which type. source: where scans come from, see :data:`hal.fake.scan.ScanSource`.
        unit: serial number, clock error and the like. rotor: instants of the revolutions; default the model's motor.
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
        self.source = source
        self._loop = loop or asyncio.get_running_loop()
        self._random = Random(self.unit.seed)
        now = self._loop.time()
        self.clock = SensorClock(now, self.unit.clock_ms, self.unit.clock_gain)
        self.rotor = rotor or EvenRotor(now, model.true_period_s)
        self.baud = self.unit.baud
        self.outlet = Outlet(self._loop, Pacing(rate=self._line_rate()))
        self.state = State.IDLE
        self.laser = False
        self.scans_sent = 0
        self._text = bytearray()
        self._requests: deque[bytes] = deque()
        self._busy = False
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._stream: tuple[Request, Measure] | None = None
        self._remaining = 0
        self._seen: tuple[int, FakeScan | None] = (-1, None)
        self._ready_at = now
        self._laser_since = now
        self._last_rb = float("-inf")
        self._last_out = 0.0
        if not self.unit.booted:
            self.power_on()
        elif self.unit.scip1:
            self.state = State.SCIP1

    # power and connection

    def power_on(self) -> None:
        """Start up: clock at zero, BOOTING, then IDLE (or SCIP 1.1)."""
        self._silence()
        now = self._loop.time()
        self.state = State.BOOTING
        self.baud = self.unit.baud
        self.outlet.pacing.rate = self._line_rate()
        self.outlet.clear()
        self.clock.set(now)
        self._ready_at = now + max(self.unit.spin_up_s, self.model.boot_s)
        self._at("boot", now + self.model.boot_s, self._booted)

    def attach(self, host: HostEnd) -> None:
        """A host has opened the line."""
        self.outlet.host = host

    def detach(self) -> None:
        """The host has gone. A network sensor stops; any other goes on talking to nobody."""
        self.outlet.host = None
        self._text.clear()
        if self.model.link == "ethernet":
            self._requests.clear()
            self.outlet.clear()
            if self.state in (State.MULTI, State.SINGLE, State.TIME_ADJUST):
                self._stop(State.IDLE)

    def close(self) -> None:
        """Cancel every timer; the object is of no use afterwards."""
        self._silence()
        self.outlet.host = None
        self.outlet.clear()

    def _booted(self) -> None:
        self.state = State.SCIP1 if self.unit.scip1 else State.IDLE

    def _silence(self) -> None:
        for timer in self._timers.values():
            timer.cancel()
        self._timers.clear()
        self._requests.clear()
        self._text.clear()
        self._busy = False
        self._stream = None
        self.laser = False

    def _at(self, name: str, when: float, call: Callable[[], None]) -> None:
        if name in self._timers:
            self._timers[name].cancel()
        self._timers[name] = self._loop.call_at(when, call)

    def _line_rate(self) -> float:
        return RATES.get(self.model.link, self.baud / 10.0)

    # what the host says

    def receive(self, data: bytes) -> None:
        """Bytes from the host."""
        self._text += data
        *whole, rest = LINE_ENDS.split(bytes(self._text))
        self._text = bytearray(rest[: MAX_LINE + 1])
        for line in whole:
            if line:
                self._requests.append(line[: MAX_LINE + 1])
        self._next()

    def _next(self) -> None:
        if self._busy or not self._requests:
            return
        self._busy = True
        jitter = abs(self._random.gauss(0.0, self.model.jitter_s))
        due = self._loop.time() + self.model.latency_s + jitter
        self._at("command", self.clock.next_tick(due, self.model.tick_s), self._execute)

    def _execute(self) -> None:
        line = self._requests.popleft()
        repeats = line != b"RB" and line in self._requests
        wait = self._scip1(line) if self.state is State.SCIP1 else self._obey(line)
        if repeats and self.state is not State.SCIP1:
            self._requests = deque(other for other in self._requests if other != line)
            self._reply(line, "0B")
        if not wait:
            self._done()

    def _done(self) -> None:
        self._busy = False
        self._next()

    def _reply(self, echo: bytes, status: str, body: bytes = b"") -> None:
        self.outlet.send(scip_encoder.reply(echo, status, body))

    def _scip1(self, line: bytes) -> bool:
        if line == b"SCIP2.0":
            self.state = State.IDLE
            self.outlet.send(b"SCIP2.0\n0\n\n")
        elif line == b"V":
            self.outlet.send(b"V\n0\n" + texts.scip1(self.model, self.unit) + b"\n")
        else:
            self.outlet.send(line + b"\nE\n\n")
        return False

    def _obey(self, line: bytes) -> bool:
        """Carry a line out; True when its answer comes later and the next command has to wait for it."""
        request = parse(line, self.model)
        if isinstance(request, Refusal):
            self._reply(line, request.status)
            return False
        cell = answer(self.model.profile, self.state, request.name, request.parameters)
        if cell == "do":
            return bool(self._handlers()[request.name](request))
        if cell != "--":
            self._reply(line, cell)
        return False

    def _handlers(self) -> dict[str, Callable[[Request], bool | None]]:
        return {
            "VV": self._ask, "PP": self._ask, "II": self._ask, "%ST": self._ask, "TM": self._time,
            "BM": self._laser_on, "QT": self._quit, "RS": self._reset, "RT": self._reset, "RB": self._reboot,
            "SS": self._set_baud, "CR": self._set_speed, "HS": self._set_speed, "%SL": self._sleep,
            **dict.fromkeys(STREAMS, self._start_stream),
            **dict.fromkeys(("GD", "GS", "GE", "HD", "HE"), self._get_one),
        }  # fmt: skip

    def _ask(self, request: Request) -> None:
        if request.name == "%ST":
            body = scip_encoder.summed_line(self.state.value.encode("ascii"))
        else:
            body = texts.lines(self._pairs(request.name), scip_encoder.text_line)
        self._reply(request.echo, "00", body)

    def _pairs(self, name: str) -> texts.Lines:
        if name == "VV":
            return texts.identity(self.model, self.unit)
        if name == "PP":
            return texts.parameters(self.model)
        tick = self.clock.tick(self._loop.time())
        return texts.state(self.model, texts.Live(self.state, self.laser, self.baud, tick))

    def _time(self, request: Request) -> None:
        if request.parameters == b"0":
            self._stop(State.TIME_ADJUST)
        elif request.parameters == b"2":
            self.state = State.IDLE
        elif self.state is not State.TIME_ADJUST and self.unit.strict_time:
            return self._reply(request.echo, "04")
        else:
            stamp = scip_encoder.number(self.clock.tick(self._loop.time()), 4)
            return self._reply(request.echo, "00", scip_encoder.summed_line(stamp))
        return self._reply(request.echo, "00")

    def _laser_on(self, request: Request) -> None:
        self._light(State.SINGLE)
        self._reply(request.echo, "00")

    def _light(self, state: State) -> None:
        if not self.laser:
            self._laser_since = self._loop.time()
        self.laser, self.state = True, state

    def _quit(self, request: Request) -> None:
        self._stop(State.IDLE)
        self._reply(request.echo, "00")

    def _stop(self, state: State) -> None:
        if "scan" in self._timers:
            self._timers.pop("scan").cancel()
        self._stream = None
        self.outlet.drop_waiting_scans()
        self.laser, self.state = False, state

    def _reset(self, request: Request) -> bool:
        if self.state is not State.BOOTING:
            self._stop(State.IDLE)
        self._at("reset", self._loop.time() + self.model.reset_s, lambda: self._reset_done(request))
        return True

    def _reset_done(self, request: Request) -> None:
        self.clock.set(self._loop.time())
        self._reply(request.echo, "00")
        if request.name == "RS" and self.model.link == "rs232":
            self._at("baud", self._loop.time() + 0.01, lambda: self._use_baud(self.unit.baud))
        self._done()

    def _reboot(self, request: Request) -> None:
        now = self._loop.time()
        if now - self._last_rb > REBOOT_PAIR_S:
            self._last_rb = now
            return self._reply(request.echo, "01")
        self._last_rb = float("-inf")
        self._at("reboot", now + REBOOT_PAIR_S, self._restart)
        return self._reply(request.echo, "00")

    def _restart(self) -> None:
        host = self.outlet.host
        self.power_on()
        if host is not None and self.model.link != "rs232":
            host.hang_up()

    def _set_baud(self, request: Request) -> None:
        digits = request.parameters
        if self.model.link == "ethernet":
            return self._reply(request.echo, "0F")
        if not digits.isdigit():
            return self._reply(request.echo, "01")
        baud = int(digits)
        if baud not in BAUDS:
            return self._reply(request.echo, "02")
        if baud == self.baud:
            return self._reply(request.echo, "03")
        self._reply(request.echo, "00")
        return self._at("baud", self._loop.time() + 0.01, lambda: self._use_baud(baud))

    def _use_baud(self, baud: int) -> None:
        self.baud = baud
        self.outlet.pacing.rate = self._line_rate()

    def _set_speed(self, request: Request) -> None:
        if request.name == "HS":
            return self._reply(request.echo, "00")
        if not self.model.speeds:
            return self._reply(request.echo, "04")
        return self._reply(request.echo, "03" if request.parameters == b"00" else "02")

    def _sleep(self, request: Request) -> None:
        self._stop(State.SLEEP)
        self._reply(request.echo, "00")

    # scans

    def _complete_at(self, index: int) -> float | None:
        start = self.rotor.start_of(index)
        return None if start is None else start + self.rotor.period() * self.model.amax / self.model.ares

    def _first_index(self) -> int:
        return self.rotor.index_after(max(self._loop.time(), self._ready_at))

    def _scan(self, index: int) -> FakeScan | None:
        if self._seen[0] != index:
            start = self.rotor.start_of(index)
            self._seen = (index, None if start is None else self.source(start))
        return self._seen[1]

    def _start_stream(self, request: Request) -> None:
        wanted = measure(request, self.model)
        if isinstance(wanted, str):
            return self._reply(request.echo, wanted)
        self._stop(self.state)
        self._light(State.MULTI)
        self._reply(request.echo, "00")
        self._stream = request, wanted
        self._remaining = wanted.count
        return self._plan(self._first_index())

    def _plan(self, index: int) -> None:
        complete = self._complete_at(index)
        if complete is not None:
            due = self.clock.next_tick(complete, self.model.tick_s)
            self._at("scan", due, lambda: self._emit(index))

    def _emit(self, index: int) -> None:
        if self._stream is None:
            return
        request, wanted = self._stream
        scan = self._scan(index)
        if scan is not None:
            endless = wanted.count == 0
            self._remaining -= 0 if endless else 1
            echo = request.name.encode() + request.parameters[:-2] + b"%02d" % self._remaining + request.tag
            self._send_scan(echo, "99", index, scan)
            if not endless and self._remaining == 0:
                self._finish_stream()
                return
        self._plan(index + 1 + wanted.skip)

    def _finish_stream(self) -> None:
        self._stream = None
        self._timers.pop("scan", None)
        self.laser, self.state = False, State.IDLE

    def _send_scan(self, echo: bytes, status: str, index: int, scan: FakeScan) -> None:
        request_name = echo[:2].decode("ascii")
        wanted = measure(Request(echo, request_name, echo[2:].partition(b";")[0], b""), self.model)
        start = self.rotor.start_of(index)
        if isinstance(wanted, str) or start is None:
            raise AssertionError("a stream was accepted that cannot be sent")
        body = scip_encoder.measurement(self.clock.tick(start), payload(request_name, wanted, scan, self.model.dmin))
        self.scans_sent += 1
        self.outlet.send(scip_encoder.reply(echo, status, body), is_scan=status == "99")

    def _get_one(self, request: Request) -> bool:
        wanted = measure(request, self.model)
        if isinstance(wanted, str):
            self._reply(request.echo, wanted)
            return False
        span = self.rotor.period() * self.model.amax / self.model.ares
        index = self.rotor.index_after(self._loop.time() - span) - 1
        start = self.rotor.start_of(index)
        if start is None or start < max(self._laser_since, self._ready_at):
            index = self.rotor.index_after(max(self._laser_since, self._ready_at))
        due = self._complete_at(index)
        if due is None:
            return False
        self._at("single", due, lambda: self._got_one(request, index))
        return True

    def _got_one(self, request: Request, index: int) -> None:
        scan = self._scan(index)
        if scan is not None:
            self._send_scan(request.echo, "00", index, scan)
        self._done()
