"""A recording as a source of stream messages: replayed through the daemon's cycle, as its stream would send it."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from daemon.config.schema import Config
from daemon.health.reasons import REASONS, Reason
from daemon.publish.stream import messages
from daemon.publish.stream import server as stream_server
from daemon.publish.stream.messages import Frame, Raw
from daemon.publish.stream.server import Client, StreamServer
from daemon.publish.stream.ticker import BEAT_S, in_words
from daemon.replay.recorded_inputs import NOTHING_GIVEN, Given, config_for, lights_for, start_for
from daemon.replay.runner import Rerun
from daemon.replay.sources import Source
from hal.adc import RawSamples
from hal.lidar import RawScan
from hal.replay.recording import Kind, open_recording
from hal.replay.report import LogReport

PASSED = {Kind.RX: "rx", Kind.TX: "tx", Kind.OPEN: "open", Kind.LOST: "lost", Kind.BAUD: "baud"}


class InProcessClient(Client):
    """A client of the stream server in this process, without a socket."""

    def __init__(self, server: StreamServer, receive: Callable[[Frame], object]) -> None:
        super().__init__(server)
        self.wants = frozenset({*stream_server.LATEST, *stream_server.ONCE, *stream_server.RAW})
        self._receive = receive
        server.clients.add(self)

    def tell(self, topic: str, body: bytes) -> None:
        """Decode and deliver a message at once."""
        self._receive(messages.read(topic, body))


class RecordingSource:
    """Stream messages of a log that is replayed through the daemon's own cycle.

    Attributes:
        source, config, rerun: as `daemon.cli.replay` has them.

    Raises:
        HalError: its configuration, survey or map cannot be used.
    """

    def __init__(self, source: Source, config: Config, given: Given = NOTHING_GIVEN) -> None:
        self.source = source
        self.config = config_for(self.source, config, given)
        lights = lights_for(self.source, self.config, given)
        start = start_for(self.source, self.config, lights, given)
        self.rerun = Rerun(self.source, self.config, lights, None, start)
        self._received: list[Frame] = []
        self._server = StreamServer(Path(), self.config.name, lambda reason: REASONS[Reason(reason)])
        InProcessClient(self._server, self._received.append)
        self.rerun.watch = lambda record: self._server.publish(record.snapshot)

    def frames(self, raw: bool = True) -> Iterator[Frame]:
        """All messages in order; ``raw``: including the bytes between daemon and devices.

        Raises:
            HalError: the rest of the log cannot be read.
        """
        passed = self._raw() if raw and self.source.recorded else iter(())
        waiting, beat_at = next(passed, None), -1.0
        for event in self.source.events():
            if isinstance(event, RawScan):
                self._server.on_scan(event)
            elif isinstance(event, RawSamples) and raw:
                self._server.on_samples(event)
            self.rerun.feed(event)
            if self.rerun.t_mono >= beat_at:
                beat_at = self.rerun.t_mono + BEAT_S
                self._server.on_faults(self.rerun.t_mono, in_words(self.rerun.faults))
            while waiting is not None and waiting.t_mono <= self.rerun.t_mono:
                yield waiting
                waiting = next(passed, None)
            yield from self._received
            self._received.clear()
        while waiting is not None:  # after the last scan: often the cause of its absence
            yield waiting
            waiting = next(passed, None)
        self.rerun.finish()

    def _raw(self) -> Iterator[Raw]:
        """The bytes at the lidar's port, from the beginning of the replay."""
        since = -1.0 if self.source.begin is None else self.source.begin.t_mono
        for frame in open_recording(self.source.path).frames(LogReport()):
            if frame.kind in PASSED and frame.channel == 0 and frame.t_mono >= since:
                kind = PASSED[Kind(frame.kind)]
                yield Raw(device="lidar", kind=kind, t_mono=frame.t_mono, data=frame.payload)
