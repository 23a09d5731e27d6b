"""The measuring head of the fake sensor: converts revolutions to data replies, once or as a stream."""

from __future__ import annotations

from collections.abc import Callable

from hal.fake.lidar import scip_encoder
from hal.fake.lidar.commands import Measure, Request
from hal.fake.lidar.device_state import DeviceState
from hal.fake.lidar.dialect_grid import State
from hal.fake.lidar.payload import payload
from hal.fake.lidar.rotor import Rotor
from hal.fake.lidar.scan import FakeScan, ScanSource
from hal.fake.lidar.scan_faults import altered
from hal.fake.lidar.scip_encoder import MAX_4


class MeasuringHead:
    """Converts revolutions to replies.

    Args:
        device: the sensor's shared state. source: of the scans. rotor: start times of the revolutions.
    """

    def __init__(self, device: DeviceState, source: ScanSource, rotor: Rotor) -> None:
        self.device = device
        self.source = source
        self.rotor = rotor
        self.scans_sent = 0
        self.slower_percent = 0
        self._slow_factor = 1.0
        self._request: Request | None = None
        self._wanted = Measure(0, 0, 1, 0, 0)
        self._remaining = 0
        self._next = 0
        self._seen: tuple[int, FakeScan | None] = (-1, None)
        self._last_tick: int | None = None
        self._last_body: bytes | None = None

    def stream(self, request: Request, wanted: Measure) -> None:
        """Send the next revolutions until `halt`, or the requested number."""
        self._request, self._wanted, self._remaining = request, wanted, wanted.count
        self._last_body = None
        self._plan(self._first_after(self.device.now()))

    def halt(self) -> None:
        """Stop streaming. A reply in transmission is completed."""
        self._request = None
        self.device.cancel("scan")
        self.device.output.drop_waiting_scans()

    def pause(self) -> None:
        """Suspend the stream; the request is kept."""
        self.device.cancel("scan")

    def resume(self) -> None:
        """Continue the suspended request."""
        if self._request is not None:
            self._plan(self._first_after(self.device.now()))

    def report(self, status: str) -> None:
        """Send a reply of the stream with a status and no data."""
        if self._request is not None:
            self.device.send(scip_encoder.reply(self._echo(), status), is_scan=True)

    def turn(self, *, slower_percent: int | None = None, slow_factor: float | None = None) -> None:
        """Change the motor's speed: by the host (CR), and by a fault."""
        self.slower_percent = self.slower_percent if slower_percent is None else slower_percent
        self._slow_factor = self._slow_factor if slow_factor is None else slow_factor
        requested = self.device.model.true_period_s / (1.0 - 0.01 * self.slower_percent)
        self.rotor.set_period(self.device.now(), requested * self._slow_factor)

    def once(self, request: Request, wanted: Measure, done: Callable[[], None]) -> None:
        """Send the latest complete revolution, or the first one to complete; then call ``done``."""
        device = self.device
        latest = self.rotor.index_after(device.now()) - 1
        if (self._complete_at(latest) or device.now()) > device.now():
            latest -= 1
        start = self.rotor.start_of(latest)
        lit = max(device.laser_since, device.ready_at)
        index = latest if start is not None and start >= lit else self.rotor.index_after(lit)

        def complete() -> None:
            scan = self._scan(index)
            if scan is not None:
                device.send(self._reply(request.echo, "00", index, scan, request.name, wanted))
            done()

        device.at("single", self._complete_at(index) or device.now(), complete)

    def _span(self, index: int) -> float:
        return self.rotor.period_of(index) * self.device.model.amax / self.device.model.ares

    def _complete_at(self, index: int) -> float | None:
        start = self.rotor.start_of(index)
        return None if start is None else start + self._span(index)

    def _first_after(self, t_mono: float) -> int:
        return self.rotor.index_after(max(t_mono, self.device.ready_at))

    def _plan(self, index: int) -> None:
        complete = self._complete_at(index)
        if complete is not None:
            self._next = index
            self.device.at("scan", self.device.clock.next_tick(complete, self.device.model.tick_s), self._emit)

    def _emit(self) -> None:
        index = self._next
        self._plan(index + 1 + self._wanted.skip)  # first: a source that raises must not end the stream
        scan = self._scan(index)
        request = self._request
        if scan is None or request is None:
            return
        other = self.device.orders.strike("status")
        if other:
            self.report(f"{int(other.number('code')):02d}")
            return
        self._remaining -= 1 if self._wanted.count else 0
        reply = self._reply(self._echo(), "99", index, scan, request.name, self._wanted)
        self.scans_sent += 1
        self.device.send(reply, is_scan=True)
        if self._wanted.count and not self._remaining:
            self._request = None
            self.device.cancel("scan")
            self.device.laser_off(State.IDLE)

    def _echo(self) -> bytes:
        assert self._request is not None
        fields = self._request.name.encode("ascii") + self._request.parameters[:-2]
        return fields + b"%02d" % self._remaining + self._request.tag

    def _scan(self, index: int) -> FakeScan | None:
        start = self.rotor.start_of(index)
        if self._seen[0] != index and start is not None:
            self._seen = index, self.source(start)
            self._check(self._seen[1])
        return self._seen[1] if start is not None else None

    def _check(self, scan: FakeScan | None) -> None:
        steps = self.device.model.steps
        if scan is not None and scan.ranges_mm.shape != (steps,):
            raise ValueError(
                f"the scan source gave {scan.ranges_mm.shape} ranges; {self.device.model.modl} needs ({steps},), "
                "one for each step from 0 to AMAX"
            )

    def _reply(self, echo: bytes, status: str, index: int, scan: FakeScan, name: str, wanted: Measure) -> bytes:
        orders, device = self.device.orders, self.device
        if self._last_body is not None and orders.strike("stuck"):
            return scip_encoder.reply(echo, status, self._last_body)
        scan = altered(scan, orders, device.model, device.chance)
        fault = orders.strike("wrong_steps")
        extra = int(fault.number("by")) if fault else 0
        body = scip_encoder.measurement(self._tick(index), payload(name, wanted, scan, device.model.dmin, extra))
        self._last_body = body
        return scip_encoder.reply(echo, status, body)

    def _tick(self, index: int) -> int:
        start = self.rotor.start_of(index)
        assert start is not None
        if self._last_tick is None or not self.device.orders.strike("frozen_stamp"):
            self._last_tick = self.device.clock.tick(start)
        jump = self.device.orders.strike("stamp_jump")
        return (self._last_tick + (int(jump.number("by_ms")) if jump else 0)) & MAX_4
