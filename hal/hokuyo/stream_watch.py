"""Watches a running SCIP stream: frames to scans, and detection of silence, damage, a stuck clock and error status."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Final

from hal.clock import Clock
from hal.errors import DataInvalid, DeviceFault, HalError
from hal.hokuyo import scip
from hal.hokuyo.scip import BadFrame, Reply, parse_reply
from hal.hokuyo.scip_line import Line
from hal.hokuyo.sensor_errors import explain_status
from hal.hokuyo.session import FIRST_SCAN_S
from hal.hokuyo.stream import ScanStream
from hal.lidar import LidarStatus, RawScan

_PATIENCE_S: Final = 1.0
_PATIENCE_PERIODS: Final = 10
_LOOK_S: Final = 0.25
_SELF_CHECK_S: Final = 10.0  # a sensor that stopped to verify an error (status 21 to 49) takes seconds
_WATCH_CABLE: Final = "check its cable and power; the daemon restarts it automatically"


class StreamWatch:
    """Receives the frames of one stream and detects its failure.

    Args:
        stream: decodes and times the scans. line: carries the stream. clock: measures silence.
        status: receives counters and the latest error. on_scan: receives every valid scan.
    """

    def __init__(
        self, stream: ScanStream, line: Line, clock: Clock, status: LidarStatus, on_scan: Callable[[RawScan], None]
    ) -> None:
        self._stream = stream
        self._line = line
        self._clock = clock
        self._status = status
        self._on_scan = on_scan
        self._trouble: asyncio.Future[HalError] = asyncio.get_running_loop().create_future()
        self._deadline = clock.now() + FIRST_SCAN_S
        self._dropped = line.dropped_bytes
        self._damaged = ""
        self._unready = ""
        self.scans = 0

    @property
    def has_scans(self) -> bool:
        """True once a valid scan has arrived."""
        return self.scans > 0

    def receive(self, frame: bytes, t_rx: float) -> None:
        """Process one frame of the line, with its arrival time."""
        self._note_dropped()
        try:
            reply = parse_reply(frame)
            if reply.status == scip.DATA:
                self._receive_data(reply, t_rx)
            elif reply.echo[:2] == self._stream.request.echo[:2]:
                self._receive_notice(reply)
        except BadFrame as error:
            self._reject(str(error))

    async def watch(self) -> None:
        """Wait until the stream fails, and raise the cause; never returns.

        Raises:
            DeviceMissing: the port is gone. DeviceFault: silence, a stuck clock, an error status.
            DataInvalid: frames arrive, but none is valid.
        """
        self._line.set_on_lost(self._end_on_lost)
        try:
            while True:
                left = self._deadline - self._clock.now()
                if left <= 0:
                    raise self._silence()
                await asyncio.wait({self._trouble}, timeout=min(left, _LOOK_S))
                if self._trouble.done():
                    raise self._trouble.result()
        finally:
            self._line.set_on_lost(None)

    def _receive_data(self, reply: Reply, t_rx: float) -> None:
        status = self._status
        seq = status.scans + status.invalid
        scan = self._stream.decode(reply, t_rx, seq)
        if scan is None:
            self._reject("a stamp that does not continue the sensor's clock")
            if self._stream.stuck:
                self._end(DeviceFault(self._line.port.name, "repeats one scan, and its clock has stopped"))
            return
        status.scans += 1
        status.error = None
        self.scans += 1
        self._damaged = ""
        self._deadline = t_rx + max(_PATIENCE_S, _PATIENCE_PERIODS * self._stream.period_s)
        self._on_scan(scan)

    def _receive_notice(self, reply: Reply) -> None:
        """Process a status inside the stream: acknowledgement, self-check, error."""
        if reply.status == scip.UNSTABLE:
            self._unready = reply.status
        if reply.status in (scip.ACCEPTED, scip.RESUMED, "0B", scip.UNSTABLE):
            return
        if reply.status.isdigit() and 21 <= int(reply.status) <= 49:
            self._deadline = max(self._deadline, self._clock.now() + _SELF_CHECK_S)
            self._status.error = explain_status(self._line.port.name, "stream", reply.status)
            return
        self._end(explain_status(self._line.port.name, "stream", reply.status))

    def _reject(self, why: str) -> None:
        self._status.invalid += 1
        self._damaged = why
        self._status.error = DataInvalid(self._line.port.name, f"a frame was dropped: {why}")

    def _note_dropped(self) -> bool:
        dropped = self._line.dropped_bytes
        if dropped == self._dropped:
            return False
        self._dropped = dropped
        self._status.resyncs += 1
        return True

    def _silence(self) -> HalError:
        name = self._line.port.name
        if self._note_dropped() and not self._damaged:
            return DataInvalid(name, "only unreadable bytes arrive", "check its cable and, on RS-232, the line rate")
        if self._damaged:
            return DataInvalid(name, f"only damaged replies arrive ({self._damaged})", _WATCH_CABLE)
        if self._unready and not self.scans:
            return explain_status(name, "stream", self._unready)
        what = "has stopped sending" if self.scans else f"sends no scan within {FIRST_SCAN_S:g} s"
        return DeviceFault(name, what, _WATCH_CABLE)

    def _end_on_lost(self) -> None:
        if self._line.lost is not None:
            self._end(self._line.lost)

    def _end(self, error: HalError) -> None:
        if not self._trouble.done():
            self._trouble.set_result(error)
