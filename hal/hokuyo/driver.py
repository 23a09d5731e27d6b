"""The HOKUYO driver: finds the sensor, streams, and recovers from failures of sensor and cable.

Recovery escalates with each failed stream since the last valid scans: restart the stream (QT), reset the sensor (RT or
RS), reopen the port. A lasting trouble is answered by reboots at growing distances (RB; a reset where the model has
none). Only valid scans end it: a sensor that opens but never delivers must not look healthy (Hokuyo-aut/urg_node2 pull
request 5). A sensor that refuses to measure for now is asked again every second, without resets. Attempts begin 0.2 to
4 s apart; the driver never gives up.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import random
from collections.abc import Callable
from functools import partial
from typing import Final

from hal.clock import Clock
from hal.errors import DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.hokuyo import discover
from hal.hokuyo.models import Identity, line_speed, stream_request
from hal.hokuyo.payload import ScanRequest
from hal.hokuyo.reboot_pacing import RebootPacing
from hal.hokuyo.scip import BAUD_RATES
from hal.hokuyo.scip_line import Line
from hal.hokuyo.sensor_errors import AbnormalState, NotReady
from hal.hokuyo.session import Session
from hal.hokuyo.stream import ScanStream
from hal.hokuyo.stream_watch import StreamWatch
from hal.lidar import LidarGeometry, LidarStatus, Link, RawScan
from hal.port.port import PortOpener
from hal.port.recovery import stay_connected

log = logging.getLogger(__name__)

AUTO: Final = "auto"
_USB_BAUD: Final = 115200  # ignored by USB, but a tty needs a rate
_PAUSE_S: Final = (0.2, 4.0)
_READY_PAUSE_S: Final = 1.0  # while the sensor refuses to measure for now
_RESET_FROM: Final = 2  # failed streams since the last run of valid scans
_REOPEN_FROM: Final = 3
_REBOOT_FROM: Final = 4
_GOOD_RUN: Final = 10  # valid scans of one stream
_CALM_S: Final = 30.0  # of streaming, after which a problem is logged again


class HokuyoDriver:
    """A :class:`hal.lidar.Lidar` for every SCIP 2.x sensor on USB, RS-232 or Ethernet.

    Args:
        device: path, ``tcp://host:port``, or ``auto``: the first port at which a HOKUYO answers.
        clock: the clock of the ports' arrival times.
        opener: opens ports (:func:`hal.port.opening.open_port`).
        serial: the sensor's serial number (``VV SERI``); with ``auto`` it is found at any port.
        baud: RS-232 rate to use; 0: the lowest that carries every revolution. Ignored on USB and Ethernet; a port of
            unknown kind counts as an RS-232 line where a rate is given.
        intensity: request intensities where model and firmware support them.

    Raises:
        ValueError: a rate that SCIP does not have.
    """

    def __init__(
        self,
        device: str,
        *,
        clock: Clock,
        opener: PortOpener,
        serial: str = "",
        baud: int = 0,
        intensity: bool = False,
    ) -> None:
        if baud and baud not in BAUD_RATES:
            raise ValueError(
                f"line rate {baud}: SCIP has {', '.join(map(str, BAUD_RATES))}, or 0 for automatic detection"
            )
        self._device = device
        self._clock = clock
        self._opener = opener
        self._serial = serial
        self._baud = baud
        self._intensity = intensity
        self._status = LidarStatus()
        self._geometry: LidarGeometry | None = None
        self._faults = 0
        self._attempts = 0
        self._t_attempt = -math.inf
        self._reboots = RebootPacing()
        self._opened = False
        self._rate_cap = max(BAUD_RATES)
        self._rate_found = 0
        self._logged: set[str] = set()
        self._loss_logged = False
        self._announced = False
        self._random = random.Random(device + serial)

    @property
    def geometry(self) -> LidarGeometry | None:
        """The geometry that the sensor last reported; None before the first time."""
        return self._geometry

    @property
    def status(self) -> LidarStatus:
        """Live state and counters."""
        return self._status

    async def run(self, on_scan: Callable[[RawScan], None]) -> None:
        """Deliver scans until cancelled; then switch the laser off, within 0.1 s."""
        await stay_connected(self._status, partial(self._connection, on_scan), self._note, self._pause)

    # one connection

    async def _connection(self, on_scan: Callable[[RawScan], None]) -> None:
        """Open, stream, and recover on the open port; returns or raises when the port must be reopened."""
        self._status.link = Link.OPENING
        self._t_attempt = self._clock.now()
        session = await self._find()
        if self._opened:
            self._status.reconnects += 1
        self._opened = True
        try:
            while True:
                try:
                    await self._stream(session, on_scan)
                except DeviceMissing:
                    raise
                except HalError as error:
                    error = await session.with_report(error)
                    self._note(error)
                    if not isinstance(error, (DeviceRefused, NotReady)):
                        self._faults += 1
                    if not await self._mend(session, error):
                        return
        except asyncio.CancelledError:
            await session.quiet()
            raise
        finally:
            session.line.close()

    async def _mend(self, session: Session, error: HalError) -> bool:
        """Prepare another stream on the open port; False where the port must be reopened."""
        self._status.link = Link.OPENING
        self._status.resyncs += 1
        identity = session.identity
        assert identity is not None
        grave = isinstance(error, (AbnormalState, NotReady)) or self._faults >= _REBOOT_FROM
        if grave and await self._rebooted(session, error):
            return False
        if isinstance(error, NotReady):
            await asyncio.sleep(_READY_PAUSE_S)
            await session.leave_time_adjust()
            return True
        if self._faults >= _REOPEN_FROM or isinstance(error, (AbnormalState, DeviceRefused)):
            return False
        await asyncio.sleep(self._pause())
        if session.baud:
            await session.find_rate(session.baud)
        await session.settle()
        if self._faults >= _RESET_FROM:
            await session.reset()
        await self._suit_rate(session, identity)
        return True

    async def _rebooted(self, session: Session, error: HalError) -> bool:
        """Reboot the sensor where that is due, or reset one without RB; returns whether it was."""
        if not self._reboots.is_due(error, self._clock.now()):
            return False
        if isinstance(error, AbnormalState) or (session.identity and session.identity.facts.allows("RB")):
            await session.reboot()
        else:
            with contextlib.suppress(DeviceFault):
                await session.reset()
        self._reboots.add_reboot(self._clock.now())
        return True

    async def _find(self) -> Session:
        """Open the configured device, or the first candidate that is the configured sensor."""
        if self._device != AUTO:
            return await self._open(self._device)
        problems: list[HalError] = []
        for device in discover.candidates():
            try:
                return await self._open(device)
            except HalError as error:
                problems.append(error)
        wanted = f"no HOKUYO {self._serial} was found" if self._serial else "no HOKUYO was found"
        if not problems:
            raise DeviceMissing(AUTO, wanted, "connect the sensor, or name its device file")
        telling = (type(e) for kind in (NotReady, DeviceRefused) for e in problems if isinstance(e, kind))
        kind = next(telling, type(problems[0]))
        raise kind(AUTO, f"{wanted}: {'; '.join(map(str, problems))}")

    async def _open(self, device: str) -> Session:
        """Return a session with the right sensor, idle and identified."""
        rs232 = discover.is_rs232(device, self._baud)
        port = await self._opener(device, self._rate_found or self._baud or (BAUD_RATES[0] if rs232 else _USB_BAUD))
        session = Session(Line(port))
        identity: Identity | None = None
        try:
            identity = await self._identify(session, rs232)
        except asyncio.CancelledError:
            await session.quiet()
            raise
        finally:
            if identity is None:
                session.line.close()
        self._geometry = identity.geometry
        self._describe(device, session, identity)
        return session

    async def _identify(self, session: Session, rs232: bool) -> Identity:
        """Prepare the sensor; where it refuses that, add its own report to the error, and reboot it if that is due."""
        try:
            return await self._prepare(session, rs232)
        except (AbnormalState, NotReady) as error:
            reported = self._status.error = await session.with_report(error)
            await self._rebooted(session, reported)
            raise reported from error

    async def _prepare(self, session: Session, rs232: bool) -> Identity:
        """Bring the sensor to idle, identify it, and set the line rate."""
        if rs232:
            await session.find_rate(self._rate_found or self._baud)
        await session.settle()
        if self._faults >= _REOPEN_FROM:
            await session.reset()
        identity = await session.identify()
        serial = identity.geometry.serial
        if self._serial and serial != self._serial:
            other = f"is sensor {serial}" if serial else "gives no readable serial number"
            raise DeviceRefused(session.device, f"{other}, not {self._serial}", f'set device = "{AUTO}"')
        await self._suit_rate(session, identity)
        return identity

    async def _suit_rate(self, session: Session, identity: Identity) -> None:
        """RS-232: change to the configured rate, or to the lowest that carries every revolution."""
        if not session.baud:
            return
        everything = ScanRequest("MD", identity.geometry.amin, identity.geometry.amax)
        needed = 10.0 * everything.frame_bytes / identity.geometry.period_s
        rates = [rate for rate in BAUD_RATES if rate <= self._rate_cap]
        wanted = self._baud if self._baud in rates else next((r for r in rates if r >= needed), rates[-1])
        if wanted != session.baud and (self._baud or wanted > session.baud):
            try:
                await session.set_rate(wanted)
            except (DeviceFault, DeviceRefused) as error:
                self._rate_cap = max([rate for rate in BAUD_RATES if rate < wanted], default=BAUD_RATES[0])
                if isinstance(error, DeviceFault):
                    raise
                await self._suit_rate(session, identity)  # this host does not support that rate: try the next lower one
        self._rate_found = session.baud

    def _describe(self, device: str, session: Session, identity: Identity) -> None:
        facts = {"device": device, "model": identity.geometry.model, "serial": identity.geometry.serial}
        facts["firmware"] = identity.geometry.firmware
        facts["state"] = session.report.health
        if session.baud:
            facts["baud"] = str(session.baud)
        self._status.extra.update(facts)

    # one stream

    async def _stream(self, session: Session, on_scan: Callable[[RawScan], None]) -> None:
        """Start the stream and watch it; raises the error that ended it."""
        identity = session.identity
        assert identity is not None
        speed = line_speed(session.device, session.baud, identity.facts)
        request = await self._choose(session, identity, speed)
        stream = ScanStream(identity, request, self._status, speed)
        watch = StreamWatch(stream, session.line, self._clock, self._status, self._passing(on_scan))
        dialect = f"{identity.protocol or 'SCIP 2'} {request.name}"
        dialect += f", {request.cluster} steps together" if request.stride > 1 else ""
        dialect += f", every {request.skip + 1}. revolution" if request.skip else ""
        self._status.dialect = dialect
        try:
            await session.start(request, watch.receive, lambda: watch.has_scans)
            await watch.watch()
        finally:
            session.line.on_frame = None

    async def _choose(self, session: Session, identity: Identity, speed: float) -> ScanRequest:
        """Choose the stream; a mode with intensities is tested with one scan first and dropped if it fails."""
        request = stream_request(identity, intensity=self._intensity, bytes_per_s=speed)
        if not self._intensity:
            return request
        verdict = "the model has none"
        if request.name == "ME":
            verdict = "stopped after failures" if self._faults >= _REOPEN_FROM else await session.prove(request)
        self._status.extra["intensity"] = f"off: {verdict}" if verdict else "on"
        if not verdict:
            return request
        await session.settle()
        return stream_request(identity, intensity=False, bytes_per_s=speed)

    def _passing(self, on_scan: Callable[[RawScan], None]) -> Callable[[RawScan], None]:
        """Return a callback that passes scans on and resets recovery after a run of them (a stuck sensor sends one)."""
        began, count = self._clock.now(), 0

        def pass_on(scan: RawScan) -> None:
            nonlocal count
            count += 1
            self._status.link = Link.STREAMING
            if count == _GOOD_RUN:
                self._faults = self._attempts = 0
                self._reboots.add_success(scan.t_rx)
                if self._loss_logged or not self._announced:
                    word = "delivers again" if self._loss_logged else f"(serial {scan.geometry.serial}) delivers scans"
                    log.info("%s: lidar %s %s", self._status.extra["device"], scan.geometry.model, word)
                    self._loss_logged, self._announced = False, True
            if self._logged and scan.t_rx - began > _CALM_S:
                self._logged.clear()
            on_scan(scan)

        return pass_on

    # failures

    def _note(self, error: HalError) -> None:
        """Store the error in the status; log each problem once until scans have arrived for a while.

        The level is INFO: the daemon warns of lasting faults by their number.
        """
        self._status.error = error
        self._attempts += 1
        self._reboots.add_failure(error, self._clock.now())
        if error.problem not in self._logged:
            self._logged.add(error.problem)
            self._loss_logged = True
            log.info("lidar lost: %s", error)

    def _pause(self) -> float:
        """Seconds until the next attempt: attempts begin at doubling distances, with jitter between hosts."""
        low, high = _PAUSE_S
        apart = min(low * 2.0 ** min(max(self._attempts - 1, 0), 10), high)
        if isinstance(self._status.error, NotReady):
            apart = low + _READY_PAUSE_S
        left = apart - (self._clock.now() - self._t_attempt)
        return max(left, low) * self._random.uniform(0.8, 1.0)
