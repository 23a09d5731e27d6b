"""SCIP session: brings a sensor from any state to streaming, and back to idle.

A sensor may be idle, streaming (a serial sensor does not notice the loss of its host), in time-adjust mode, still in
SCIP 1.1, at another line rate, in the middle of a frame, booting, or in its error state. The steps through all of them:

    settle    QT until it is acknowledged; meanwhile TM2 out of time adjustment, ``SCIP2.0`` out of SCIP 1.1
    reset     RT or RS, only after failures
    identify  VV, PP, II
    set_rate  RS-232 only
    start     MD or ME
    quiet     QT, a tenth of a second at most

Sources: SCIP 2.0 C-42-03320B; SCIP 2.2 C-42-04076; ros-drivers/hokuyo_node and seqsense/urg_stamped issues 97, 103, 115
(QT is sometimes ignored and has to be repeated).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Callable, Sequence
from typing import Final

from hal.errors import DataInvalid, DeviceFault, DeviceMissing, DeviceRefused, HalError
from hal.hokuyo import scip
from hal.hokuyo.models import BEFORE_IDENTIFIED, Identity, ModelFacts, identify
from hal.hokuyo.payload import ScanRequest, parse_scan
from hal.hokuyo.scip import BadFrame, Reply, parse_reply, parse_text
from hal.hokuyo.scip_line import Line, OnFrame, legible, printable, reply_or_none
from hal.hokuyo.sensor_errors import POWER_CYCLE, AbnormalState, NotReady, SelfReport, explain_status

QUIET_S: Final = 0.1
FIRST_SCAN_S: Final = 6.0  # the motor takes 2 to 5 s to spin up after power-on
_QT_S: Final = 0.3
_QT_RS232_S: Final = 1.6  # a frame already on a slow line precedes the reply
_LISTEN_RS232_S: Final = 0.5
_LISTEN_19200_S: Final = 1.4
_TEXT_S: Final = 0.7
_ACK_S: Final = 0.5
_RESET_S: Final = 1.5
_AFTER_RESET_S: Final = 1.0
_AFTER_RATE_S: Final = 0.15
_AFTER_REBOOT_S: Final = 2.0
_REPORT_S: Final = 5.0
"""II is queried no more often than this after failures: old firmware fails under many queries (urg_c PR 4)."""
_NO_ANSWER: Final = "check that it is a HOKUYO, and check its power and cable"
_UNREADABLE: Final = "only unreadable bytes arrive"
_OTHER_PORT: Final = "name the lidar's port without a line rate"


class Session:
    """One open line and the identity of the sensor behind it.

    Args:
        line: already started. baud: rate of an RS-232 line, 0 for USB and Ethernet.
    """

    def __init__(self, line: Line, baud: int = 0) -> None:
        self.line = line
        self.baud = baud
        self.identity: Identity | None = None
        self.report = SelfReport()
        self._t_report = -math.inf

    @property
    def device(self) -> str:
        """The port's name, for errors."""
        return self.line.port.name

    @property
    def _facts(self) -> ModelFacts:
        return BEFORE_IDENTIFIED if self.identity is None else self.identity.facts

    # from any state to idle

    async def settle(self) -> None:
        """Make the sensor idle in SCIP 2.x, from any state.

        Raises:
            DeviceFault: no answer, an answer that is not SCIP, or no idle state. NotReady: QT is refused for now.
            AbnormalState: it reports 0L.
        """
        status = ""
        for _ in range(6):
            reply = await self._quit()
            if reply.legacy:
                await self._try(scip.TO_SCIP2, _TEXT_S)
                continue
            status = reply.status
            if status == scip.ACCEPTED:
                return
            if status == scip.ABNORMAL:
                raise AbnormalState(self.device, "in its error state (0L)", POWER_CYCLE)
            if status in scip.NOT_NOW:
                await self._try(scip.TM_LEAVE, _TEXT_S)
        kind = NotReady if status in scip.NOT_NOW else DeviceFault
        raise kind(self.device, f"does not become idle, QT answers {status or 'as SCIP 1.1'}", POWER_CYCLE)

    async def leave_time_adjust(self) -> None:
        """Leave the time-adjust mode, in which some firmware accepts QT and refuses every measurement.

        Raises:
            DeviceFault: as :meth:`settle`.
        """
        await self._try(scip.TM_LEAVE, _TEXT_S)
        await self.settle()

    async def _quit(self) -> Reply:
        for _ in range(3):
            reply = await self._try(scip.QT, _QT_RS232_S if self.baud else _QT_S)
            if reply is not None:
                return reply
        if self.line.is_foreign:
            raise self.foreign_device(self.line.first_bytes)
        problem = _UNREADABLE if self.line.dropped_bytes else "no reply"
        remedy = "disconnect other clients; it serves only one" if self.device.startswith("tcp:") else _NO_ANSWER
        raise DeviceFault(self.device, problem, remedy)

    def foreign_device(self, first: bytes) -> DeviceFault:
        """The error for a device that sends other bytes than SCIP; it quotes them, to help identify the device.

        The bytes stand in the remedy: a problem is logged once per text, and the bytes differ each time.
        """
        other = "name the address and port of the lidar" if self.device.startswith("tcp:") else _OTHER_PORT
        return DeviceFault(self.device, _UNREADABLE, f"the device does not use SCIP, {printable(first)!r}: {other}")

    async def find_rate(self, first: int = 0) -> None:
        """Find the rate of an RS-232 line: try ``first``, then every SCIP rate.

        Raises:
            DeviceFault: no rate gives an answer.
        """
        rates: Sequence[int] = [first, *scip.BAUD_RATES] if first else scip.BAUD_RATES
        strange = b""
        for rate in dict.fromkeys(rates):
            self.line.first_bytes = b""
            try:
                self.line.port.set_baud(rate)
            except DeviceRefused:  # this host does not support it
                continue
            before = self.line.recognised
            reply = await self._try(scip.QT, _LISTEN_19200_S if rate <= 19200 else _LISTEN_RS232_S)
            if reply is not None or self.line.recognised > before:
                self.baud = rate
                return
            strange = max(strange, self.line.first_bytes, key=legible)
        if strange:
            raise self.foreign_device(strange)
        raise DeviceFault(self.device, "no reply at any line rate", _NO_ANSWER)

    async def reset(self) -> None:
        """Reset: default speed, clock at zero, laser off; keeps the line rate where the model allows.

        Raises:
            DeviceFault: no answer to two commands.
        """
        command = scip.RT if self._facts.allows("RT") else scip.RS
        for _ in range(2):
            if await self._try(command, _RESET_S) is not None:
                break
        else:
            raise DeviceFault(self.device, "does not answer a reset", POWER_CYCLE)
        await asyncio.sleep(_AFTER_RESET_S)
        if self.baud and command == scip.RS:  # RS resets the line rate as well
            await self.find_rate(scip.BAUD_RATES[0])
        await self.settle()

    async def reboot(self) -> None:
        """Send RB twice within a second; the port must be reopened afterwards."""
        with contextlib.suppress(HalError):
            for _ in range(2):
                await self._try(scip.RB, 0.3)
            await asyncio.sleep(_AFTER_REBOOT_S)

    # identification

    async def identify(self) -> Identity:
        """Query VV, PP and II. Only PP is needed to measure: a sensor that denies the others is identified without.

        Raises:
            DeviceFault: PP is not readable. NotReady: PP is refused, or not answered although QT was.
            DeviceRefused: a sensor that this driver does not support.
        """
        vv = await self._optional(scip.VV)
        pp = await self._text(scip.PP)
        vv = vv or await self._optional(scip.VV)  # a sensor may have started meanwhile
        self.identity = identify(self.device, vv, pp)
        self.report = SelfReport.of(await self._optional(scip.II, tries=1))
        return self.identity

    async def with_report(self, error: HalError) -> HalError:
        """The error with what the sensor reports of itself in II (SCIP 2.2 answers it even in the error state)."""
        if isinstance(error, (DataInvalid, DeviceMissing, DeviceRefused)):
            return error
        now = asyncio.get_running_loop().time()
        if now - self._t_report >= _REPORT_S:
            self._t_report = now
            self.report = SelfReport.of(await self._ask(scip.II))
        return self.report.added_to(error)

    async def _ask(self, command: bytes) -> dict[str, str]:
        """The text lines of one reply, as far as they are readable; empty without a reply."""
        with contextlib.suppress(HalError):
            reply = await self._try(command, _TEXT_S)
            return parse_text(reply, strict=False) if reply is not None and reply.status == scip.ACCEPTED else {}
        return {}

    async def _optional(self, command: bytes, tries: int = 4) -> dict[str, str]:
        """As :meth:`_text`; empty where the sensor gives no readable answer."""
        try:
            return await self._text(command, tries, silences=1)
        except (AbnormalState, DeviceMissing):
            raise
        except HalError:
            return {}

    async def _text(self, command: bytes, tries: int = 4, silences: int = 2) -> dict[str, str]:
        """The lines of a text reply, after up to ``tries`` queries of which ``silences`` may remain unanswered."""
        name = command[:2].decode()
        seen = b""
        problem = f"{name}: no reply, but QT is answered"
        kind: type[DeviceFault] = NotReady
        for _ in range(tries):
            frame = await self._try_frame(command, _TEXT_S)
            if frame is None:
                silences -= 1
                if not silences:
                    break
                continue
            try:
                reply = parse_reply(frame)
                if reply.status == scip.ACCEPTED:
                    return parse_text(reply, strict=frame != seen)  # same bytes twice: the firmware sums differently
                problem = f"{name}: reply {reply.status}"
                kind = NotReady if reply.status in scip.NOT_NOW else DeviceFault
                if reply.status in scip.NOT_NOW:  # some firmware accepts QT in time-adjust mode and stays there
                    await self._try(scip.TM_LEAVE, _TEXT_S)
                await self.settle()
            except BadFrame as error:
                problem, kind, seen = f"{name}: {error}", DeviceFault, frame
        raise kind(self.device, problem, POWER_CYCLE)

    # streaming

    async def set_rate(self, baud: int) -> None:
        """Change the rate of an RS-232 line; a sensor that refuses keeps its rate.

        Raises:
            DeviceRefused: this host does not support the rate; nothing was sent.
            DeviceFault: the sensor accepted and does not answer at the new rate.
        """
        self.line.port.set_baud(baud)
        self.line.port.set_baud(self.baud)
        reply = await self._try(scip.baud_command(baud), _TEXT_S)
        if reply is None or reply.status != scip.ACCEPTED:
            return
        self.line.port.set_baud(baud)
        await asyncio.sleep(_AFTER_RATE_S)
        for _ in range(2):
            if await self._try(scip.VV, _TEXT_S) is not None:
                self.baud = baud
                return
        remedy = f"name a lower rate: lidar.device = {self.device}@19200"
        raise DeviceFault(self.device, f"the connection was lost after the change to {baud} bit/s", remedy)

    async def prove(self, request: ScanRequest) -> str:
        """Test a mode that not every firmware supports with a single scan; "" if it is valid, else the problem."""
        once = ScanRequest(request.name, request.start, request.end, request.cluster, 0, 1)
        result: asyncio.Future[str] = asyncio.get_running_loop().create_future()

        def check(frame: bytes, _t_rx: float) -> None:
            reply = reply_or_none(frame)
            if reply is None or reply.status != scip.DATA or result.done():
                return
            try:
                scan = parse_scan(once, reply)
            except BadFrame as error:
                result.set_result(str(error))
            else:
                dark = scan.intensity is not None and not scan.intensity.any()
                result.set_result("every intensity is 0" if dark else "")

        self.line.on_frame = check
        try:
            reply = await self._try(once.command(), _ACK_S)
            if reply is not None and reply.status != scip.ACCEPTED:
                return f"{request.name} answers {reply.status}"
            async with asyncio.timeout(FIRST_SCAN_S):
                return await self._or_lost(result)
        except TimeoutError:
            return f"no scan within {FIRST_SCAN_S:g} s"
        finally:
            self.line.on_frame = None

    async def start(self, request: ScanRequest, on_frame: OnFrame, streaming: Callable[[], bool]) -> None:
        """Begin a stream; its frames go to ``on_frame`` from now on.

        Args:
            request: an endless one.
            on_frame: receives the frames.
            streaming: returns whether scans have arrived, which proves success where the acknowledgement was lost.

        Raises:
            DeviceFault, NotReady, AbnormalState, DeviceRefused: by status.
        """
        self.line.on_frame = on_frame
        for _ in range(3):
            reply = await self._try(request.command(), 4 * _ACK_S if self.baud else _ACK_S)
            if streaming() or (reply is not None and reply.status in (scip.ACCEPTED, "0B")):
                return
            if reply is not None:
                break
        self.line.on_frame = None
        raise self._refusal(request, reply)

    def _refusal(self, request: ScanRequest, reply: Reply | None) -> HalError:
        if reply is None:
            return DeviceFault(self.device, f"does not acknowledge {request.name}", POWER_CYCLE)
        return explain_status(self.device, request.name, reply.status, self.report)

    async def quiet(self) -> None:
        """Switch the laser off within 0.1 s; errors of the device are ignored."""
        self.line.on_frame = None
        with contextlib.suppress(HalError, TimeoutError):
            await self.line.exchange(scip.QT, QUIET_S)

    # one exchange

    async def _try_frame(self, command: bytes, timeout_s: float) -> bytes | None:
        try:
            return await self.line.exchange(command, timeout_s)
        except TimeoutError:
            return None

    async def _try(self, command: bytes, timeout_s: float) -> Reply | None:
        """The reply; None where none came or it was damaged."""
        frame = await self._try_frame(command, timeout_s)
        return None if frame is None else reply_or_none(frame)

    async def _or_lost(self, result: asyncio.Future[str]) -> str:
        def fail() -> None:
            if not result.done() and self.line.lost is not None:
                result.set_exception(self.line.lost)

        self.line.set_on_lost(fail)
        try:
            return await result
        finally:
            self.line.set_on_lost(None)
