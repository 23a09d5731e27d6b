"""The command interpreter of the fake sensor: lines from the host in order, and their replies."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from hal.fake.lidar import info_replies, scip_encoder
from hal.fake.lidar.commands import LINE_ENDS, SINGLES, STREAMS, Refusal, Request, letters, measure, parse
from hal.fake.lidar.device_state import DeviceState
from hal.fake.lidar.dialect_grid import State, response
from hal.fake.lidar.measuring_head import MeasuringHead

MAX_LINE = 256
"""Characters of a command line; further ones are dropped up to the line's end."""
MAX_WAITING = 32
"""Queued lines; further ones are lost, as in a full input buffer."""
REBOOT_PAIR_S = 1.0
"""Two RB must come within this time; the reboot follows this long after the second."""
BAUD_CHANGE_S = 0.01
"""From the reply to SS (at the old rate) to the new rate."""
BAUDS = (19200, 38400, 57600, 115200, 250000, 500000, 750000)


class Console:
    """Reads commands and answers them in order, each after the sensor's latency.

    Args:
        device: the sensor's shared state. head: its measuring head. reboot: called when RB takes effect.
    """

    def __init__(self, device: DeviceState, head: MeasuringHead, reboot: Callable[[], None]) -> None:
        self._device, self._head, self._reboot = device, head, reboot
        self._text = bytearray()
        self._lines: deque[bytes] = deque()
        self._busy = False
        self._last_rb = float("-inf")
        self._sensitivity = b"0"
        device.foreign = lambda name: scip_encoder.reply(name.encode("ascii"), "00", self._text_body(name))
        self._handlers: dict[str, Callable[[Request], None]] = {
            "VV": self._info, "PP": self._info, "II": self._info, "%ST": self._info, "TM": self._time,
            "BM": self._laser_on, "QT": self._quit, "RS": self._reset, "RT": self._reset, "RB": self._restart,
            "SS": self._set_baud, "CR": self._set_speed, "HS": self._set_sensitivity, "%SL": self._sleep,
            **dict.fromkeys(STREAMS, self._start_stream),
            **dict.fromkeys(SINGLES, self._get_one),
        }  # fmt: skip

    def receive(self, data: bytes) -> None:
        """Process bytes from the host; bytes at another line rate are dropped."""
        if not self._device.at_same_rate():
            return
        self._text += data
        *whole, rest = LINE_ENDS.split(bytes(self._text))
        self._text = bytearray(rest[: MAX_LINE + 1])
        lines = [line[: MAX_LINE + 1] for line in whole if line]
        self._lines.extend(lines[: MAX_WAITING - len(self._lines)])
        self._next()

    def reset(self) -> None:
        """Drop the incomplete line and all queued ones (power off, host gone)."""
        self._text.clear()
        self._lines.clear()
        self._busy = False
        for name in ("command", "single", "reset"):
            self._device.cancel(name)

    def _next(self) -> None:
        if self._busy or not self._lines:
            return
        self._busy = True
        device = self._device
        due = device.now() + device.model.latency_s + abs(device.chance.gauss(0.0, device.model.jitter_s))
        device.at("command", device.clock.next_tick(due, device.model.tick_s), self._execute)

    def _execute(self) -> None:
        line = self._lines.popleft()
        repeated = line != b"RB" and line in self._lines and self._device.state is not State.SCIP1
        if repeated:
            self._lines = deque(other for other in self._lines if other != line)
        self._dispatch(line)
        if repeated:
            self._reply(line, "0B")

    def _done(self) -> None:
        self._busy = False
        self._next()

    def _reply(self, echo: bytes, status: str, body: bytes = b"") -> None:
        """Answer the current command and start the next."""
        lost = self._device.orders.strike("no_reply", command=letters(echo))
        if not lost:
            self._device.send(scip_encoder.reply(echo, status, body))
        self._done()

    def _dispatch(self, line: bytes) -> None:
        device = self._device
        if device.orders.strike("ignore", command=letters(line)):
            return self._done()
        if device.state is State.SCIP1:
            return self._scip1(line)
        request = parse(line, device.model)
        if isinstance(request, Refusal):
            return self._reply(line, request.status)
        denied = device.orders.strike("denied", command=request.name)
        if denied:
            return self._reply(line, denied.text("status"))
        unready = device.not_ready() if request.name in STREAMS | SINGLES else None
        if unready:
            return self._reply(line, unready.text("status"))
        cell = response(device.model.profile, device.state, request.name, request.parameters)
        if cell == "--":
            return self._done()
        return self._handlers[request.name](request) if cell == "do" else self._reply(line, cell)

    def _scip1(self, line: bytes) -> None:
        device = self._device
        if line == b"SCIP2.0":
            device.state = State.IDLE
            device.send(b"SCIP2.0\n0\n\n")
        elif line == b"V":
            device.send(b"V\n0\n" + info_replies.scip1(device.model, device.unit) + b"\n")
        else:
            device.send(line + b"\nE\n\n")
        self._done()

    def _info(self, request: Request) -> None:
        self._reply(request.echo, "00", self._text_body(request.name))

    def _text_body(self, name: str) -> bytes:
        device = self._device
        variant = device.orders.on("text_sum")
        line = scip_encoder.TEXT_SUMS[variant.text("variant") if variant else "plain"]
        if name == "%ST":
            return scip_encoder.summed_line(device.state.value.encode("ascii"))
        if name == "VV":
            pairs = info_replies.identity(device.model, device.unit, ";beta" if device.orders.on("semicolon") else "")
            vendor = device.orders.on("vendor")
            pairs = [(key, vendor.text("text") if vendor and key == "VEND" else value) for key, value in pairs]
        elif name == "PP":
            fault = device.orders.on("dmax")
            pairs = info_replies.parameters(device.model, int(fault.number("value")) if fault else device.model.dmax)
            pairs = [(key, self._stated(key, value)) for key, value in pairs]
        else:
            pairs = info_replies.state(device.model, self._live())
        return info_replies.lines(pairs, line)

    def _stated(self, key: str, value: str) -> str:
        """The value that PP gives for a key."""
        fault = self._device.orders.on("parameter")
        return fault.text("value") if fault and fault.text("key") == key else value

    def _live(self) -> info_replies.LiveState:
        device = self._device
        fault = device.orders.on("trouble")
        trouble = fault.text("text") if fault else device.trouble
        unready = device.not_ready()
        mode = unready.text("mode") if unready else ""
        tick = device.clock.tick(device.now())
        return info_replies.LiveState(device.state, device.laser, device.baud, tick, trouble, mode)

    def _time(self, request: Request) -> None:
        device = self._device
        if request.parameters == b"0":
            self._stop(State.TIME_ADJUST)
        elif request.parameters == b"2":
            device.state = State.IDLE
        elif device.state is not State.TIME_ADJUST and device.unit.strict_time:
            return self._reply(request.echo, "04")
        else:
            stamp = scip_encoder.number(device.clock.tick(device.now()), 4)
            return self._reply(request.echo, "00", scip_encoder.summed_line(stamp))
        return self._reply(request.echo, "00")

    def _stop(self, state: State) -> None:
        self._head.halt()
        self._device.laser_off(state)

    def _laser_on(self, request: Request) -> None:
        self._device.laser_on(State.SINGLE)
        self._reply(request.echo, "00")

    def _quit(self, request: Request) -> None:
        if self._device.state not in (State.BOOTING, State.TIME_ADJUST):
            self._stop(State.IDLE)
        self._reply(request.echo, "00")

    def _sleep(self, request: Request) -> None:
        self._stop(State.SLEEP)
        self._reply(request.echo, "00")

    def _start_stream(self, request: Request) -> None:
        wanted = measure(request, self._device.model)
        if isinstance(wanted, str):
            return self._reply(request.echo, wanted)
        self._head.halt()
        self._device.laser_on(State.MULTI)
        self._head.stream(request, wanted)
        return self._reply(request.echo, "00")

    def _get_one(self, request: Request) -> None:
        wanted = measure(request, self._device.model)
        if isinstance(wanted, str):
            return self._reply(request.echo, wanted)
        return self._head.once(request, wanted, self._done)

    def _reset(self, request: Request) -> None:
        device = self._device
        if device.state is not State.BOOTING:
            self._stop(State.IDLE)

        def complete() -> None:
            device.clock.set(device.now())
            self._reply(request.echo, "00")
            if request.name == "RS":
                self._head.turn(slower_percent=0)
                self._sensitivity = b"0"
                device.at("baud", device.now() + BAUD_CHANGE_S, lambda: device.use_baud(device.unit.baud))

        device.at("reset", device.now() + device.model.reset_s, complete)

    def _restart(self, request: Request) -> None:
        now = self._device.now()
        if now - self._last_rb > REBOOT_PAIR_S:
            self._last_rb = now
            return self._reply(request.echo, "01")
        self._last_rb = float("-inf")
        self._device.at("reboot", now + REBOOT_PAIR_S, self._reboot)
        return self._reply(request.echo, "00")

    def _set_baud(self, request: Request) -> None:
        device = self._device
        if device.model.link == "ethernet":
            return self._reply(request.echo, "0F")
        if not request.parameters.isdigit():
            return self._reply(request.echo, "01")
        baud = int(request.parameters)
        if baud not in BAUDS:
            return self._reply(request.echo, "02")
        if baud == device.baud:
            return self._reply(request.echo, "03")
        self._reply(request.echo, "00")
        return device.at("baud", device.now() + BAUD_CHANGE_S, lambda: device.use_baud(baud))

    def _set_speed(self, request: Request) -> None:
        """CR: 01 to 10 turn the motor 1 to 10 % slower, 00 and 99 at its nominal speed."""
        if not self._device.model.speeds:
            return self._reply(request.echo, "04")
        if not request.parameters.isdigit():
            return self._reply(request.echo, "01")
        code = int(request.parameters) % 99
        if code > 10:
            return self._reply(request.echo, "02")
        if code == self._head.slower_percent:
            return self._reply(request.echo, "03")
        self._head.turn(slower_percent=code)
        return self._reply(request.echo, "00")

    def _set_sensitivity(self, request: Request) -> None:
        """HS: stored and compared, without effect on the ranges."""
        if request.parameters not in (b"0", b"1"):
            return self._reply(request.echo, "01")
        if request.parameters == self._sensitivity:
            return self._reply(request.echo, "02")
        self._sensitivity = request.parameters
        return self._reply(request.echo, "00")
