"""Decodes scans from the received bytes of a recorded capture, without sending anything.

It uses the splitter, codec and clock of the live driver, and yields the same scan times where the port's name and line
rate are given.
"""

from __future__ import annotations

from hal.errors import DeviceRefused
from hal.hokuyo.models import UNKNOWN_MODEL, Identity, facts_of, identify, line_speed
from hal.hokuyo.payload import ScanRequest
from hal.hokuyo.scip import ACCEPTED, DATA, BadFrame, FrameSplitter, Reply, parse_reply, parse_text
from hal.hokuyo.stream import ScanStream
from hal.lidar import LidarGeometry, LidarStatus, RawScan

_SCANS = frozenset({b"MD", b"MS", b"ME", b"ND", b"NE", b"GD", b"GS", b"GE", b"HD", b"HE"})


class PassiveHokuyo:
    """Decodes a sensor's replies without the commands of the host.

    Geometry comes from VV and PP replies in the bytes; before the first PP, from ``geometry``; with neither, scans are
    dropped and counted in ``status.invalid``. The stream's shape comes from the echo of each reply.

    Args:
        geometry: used until the bytes hold a PP reply.
        device: the port that carried the bytes, if known (for errors; its kind gives the line's speed).
        baud: rate of an RS-232 line in bit/s, 0 for any other.
        untimed: a scan whose time cannot be determined gets its arrival time instead of being dropped; for callers that
            have the times from another source.
    """

    def __init__(
        self, geometry: LidarGeometry | None = None, *, device: str = "capture", baud: int = 0, untimed: bool = False
    ) -> None:
        self._device = device
        self._untimed = untimed
        self._baud = baud
        self._splitter = FrameSplitter()
        self._identity = None if geometry is None else _given(geometry)
        self._vv: dict[str, str] = {}
        self._pp: dict[str, str] = {}
        self._doubted = b""
        self._stream: ScanStream | None = None
        self._seq = 0
        self._status = LidarStatus(dialect="SCIP 2 capture")

    @property
    def geometry(self) -> LidarGeometry | None:
        """Geometry in use, None until there is one."""
        return None if self._identity is None else self._identity.geometry

    @property
    def status(self) -> LidarStatus:
        """Counters: scans, missed, invalid (damaged, or no geometry yet), resyncs, clock_resets; latest error."""
        return self._status

    def restart(self) -> None:
        """Restart: the next bytes belong to another connection (a gap in the recording)."""
        self._splitter.reset()
        self._stream = None

    def feed(self, data: bytes, t_rx: float) -> list[RawScan]:
        """Decode bytes in the order received, with their arrival time; returns the scans that they complete."""
        scans: list[RawScan] = []
        dropped = self._splitter.dropped_bytes
        for frame in self._splitter.feed(data):
            try:
                reply = parse_reply(frame)
                if reply.echo[:2] in _SCANS:
                    scan = self._scan(reply, t_rx)
                    if scan is not None:
                        scans.append(scan)
                elif reply.status == ACCEPTED:
                    self._learn(reply)
            except BadFrame:
                self._status.invalid += 1
                self._seq += 1
            except DeviceRefused as error:
                self._status.error = error
        if self._splitter.dropped_bytes != dropped:
            self._status.resyncs += 1
        return scans

    def _learn(self, reply: Reply) -> None:
        """Take up the lines of VV or PP; unreadable ones only when the same bytes come again, as the live driver does.

        Nothing in VV is needed to measure, so that its lines are taken as far as they are readable.
        """
        if reply.echo == b"VV":
            self._vv = parse_text(reply, strict=False)
        elif reply.echo == b"PP":
            strict, self._doubted = reply.body != self._doubted, reply.body
            self._pp = parse_text(reply, strict=strict)
        if reply.echo in (b"VV", b"PP") and self._pp:
            identity = identify(self._device, self._vv, self._pp)
            if identity != self._identity:
                self._identity, self._stream = identity, None

    def _scan(self, reply: Reply, t_rx: float) -> RawScan | None:
        single = reply.echo[:1] in b"GH"
        if reply.status != (ACCEPTED if single else DATA):
            if reply.status == ACCEPTED:
                self._stream = None  # a new stream begins; the live driver starts a new clock, too
            return None  # acknowledgement, refusal, or self-check
        if self._identity is None:
            self._seq += 1
            self._status.invalid += 1
            return None
        requested = ScanRequest.of_echo(reply.echo)
        stream = self._stream
        if stream is None or not _same_stream(stream.request, requested):
            speed = line_speed(self._device, self._baud, self._identity.facts)
            stream = self._stream = ScanStream(self._identity, requested, self._status, speed)
        stream.request = requested  # a counted stream counts down in its echo
        scan = stream.decode(reply, t_rx, self._seq, self._untimed)
        self._seq += 1
        if scan is None:
            self._status.invalid += 1
        else:
            self._status.scans += 1
            self._status.error = None
            self._status.dialect = f"SCIP 2 capture {requested.name}"
        return scan


def _same_stream(a: ScanRequest, b: ScanRequest) -> bool:
    return (a.name, a.start, a.end, a.cluster, a.skip) == (b.name, b.start, b.end, b.cluster, b.skip)


def _given(geometry: LidarGeometry) -> Identity:
    return Identity("", "", geometry, facts_of("", geometry.model) if geometry.model else UNKNOWN_MODEL)
