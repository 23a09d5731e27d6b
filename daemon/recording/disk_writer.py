"""Disk thread of a recording: writes records to segments every 0.1 s and syncs them to the disk every 0.4 s.

A power cut therefore loses at most half a second. A slow, full or absent disk loses only what it could not store. Lost
records are counted, logged once, and noted in the recording as soon as there is room again. They never stop the
daemon.
"""

from __future__ import annotations

import logging
import math
import os
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from secrets import token_hex
from typing import Any, Final

from daemon.system.atomic_file import defect_in, reason_of, sync_folder, write_whole
from hal.clock import Clock
from hal.replay.recording import LONGEST, Kind, pack_frame, pack_head, segment_name

log = logging.getLogger(__name__)

WRITE_S: Final = 0.1
SYNC_S: Final = 0.4
RETRY_S: Final = 5.0
SEGMENT_BYTES: Final = 64 << 20
BACKLOG_BYTES: Final = 32 << 20
"""Bytes that may wait for a slow disk; further records are dropped and counted."""
CLOCK: Final = "clock"
"""Key in a segment head: monotonic clock and UTC at the time of writing, both in s."""
STEP_S: Final = 0.05
"""Change of UTC against the segment head, s, above which the clock counts as set; a new segment then begins."""
STEP_AGAIN_S: Final = 10.0
"""Minimum interval between two such segments, s: a clock may be set repeatedly."""
READINGS, TIGHT_S = 5, 1e-3
"""Limit of repeated readings of two clocks, and the duration, s, above which a reading repeats. The thread may have
waited between the readings."""


def both(clock: Clock) -> tuple[float, float]:
    """Returns the monotonic clock and UTC at one instant, both in s; only steps of UTC change their difference."""
    best = math.inf, 0.0, 0.0
    for _ in range(READINGS):
        begun, utc, ended = clock.now(), clock.utc(), clock.now()
        best = min(best, (ended - begun, begun, utc))
        if best[0] < TIGHT_S:
            break
    return best[1:]


@dataclass(frozen=True, slots=True, eq=False)
class Turn:
    """Marker between two records: a new segment begins here.

    Attributes:
        then: called by the writing thread with the number of the segment, or None if it could not be opened.
    """

    then: Callable[[int | None], None]


class SegmentWriter:
    """Appends records to segments in a folder of its own; `hal.replay.recording` defines the format.

    Attributes:
        folder: of this recording.
        records, bytes: written so far. lost: records that could not be written. taken: bytes of the accepted records.
        closed: called by the writing thread for every complete segment, with its number and its path.
        error: why nothing is being written at present; empty without trouble.
        busy_since: start of the write in progress (`time.monotonic`, s); None between writes.
    """

    def __init__(
        self,
        parent: Path,
        name: str,
        header: dict[str, Any],
        segment_bytes: int = SEGMENT_BYTES,
        beside: Mapping[str, bytes] | None = None,
        clock: Clock | None = None,
    ) -> None:
        """Makes the folder and opens the first segment; after a failure the writer tries again later.

        ``beside``: files by name that every segment needs; they are written into the folder before the first segment.
        ``clock``: read by the writing thread for the times in every segment head.
        """
        self.records = self.bytes = self.lost = self.taken = 0
        self.error = ""
        self.busy_since: float | None = None
        self.closed: Callable[[int, Path], None] = _nobody
        self._header = header
        self._segment_bytes = segment_bytes
        self._beside = dict(beside or {})
        self._clock = clock
        self._ahead = self._stepped_at = -math.inf
        self._segment = -1
        self._file = -1
        self._good = 0  # bytes of the open segment that end with a whole record
        self._ready: list[bytes | Turn] = []
        self._waiting = 0
        self._lock = threading.Lock()
        self._noted = 0
        self._t_mono = 0.0
        self._retry_at = 0.0
        self._synced_at = time.monotonic()
        self._dirty = False
        self._stop = threading.Event()
        self.folder = parent / f"{name}-{token_hex(4)}"  # random suffix: unique even if made later
        try:
            self.folder = _new_folder(parent, name)
            self._open()
        except OSError as error:
            self._fail(error, [])
        self._thread = threading.Thread(target=self._work, name="lumiloop-disk", daemon=True)
        self._thread.start()

    def put(self, kind: Kind, channel: int, t_mono: float, payload: bytes) -> None:
        """Queues one record; returns at once."""
        frame = pack_frame(kind, channel, t_mono, payload)
        with self._lock:
            if self._waiting + len(frame) > BACKLOG_BYTES or len(payload) > LONGEST or self._stop.is_set():
                self.lost += 1
                return
            self._ready.append(frame)
            self._waiting += len(frame)
            self.taken += len(frame)
            self._t_mono = t_mono

    def begin(self, then: Callable[[int | None], None]) -> None:
        """Begins a new segment with the next record and calls ``then`` as in :class:`Turn`; returns at once."""
        with self._lock:
            if not self._stop.is_set():
                self._ready.append(Turn(then))
                return
        then(None)

    def close(self) -> None:
        """Writes and syncs the remaining records; idempotent."""
        if not self._stop.is_set():
            self._stop.set()
            self._thread.join()

    def _work(self) -> None:
        while not self._stop.wait(WRITE_S):
            self._turn()
        self._retry_at = 0.0
        self._turn()
        self._close()

    def _turn(self) -> None:
        """Writes the queued records; on an error drops and counts them, and tries again later in a new segment."""
        with self._lock:
            ready, self._ready, self._waiting = self._ready, [], 0
        batches: list[Batch] = []
        self.busy_since = time.monotonic()
        try:
            batches = _batches(ready)
            if self._file < 0:
                if time.monotonic() < self._retry_at:
                    self._lose(batches)
                    return
                self._open()
            while batches:
                turn, frames = batches[0]
                if turn is not None:
                    self._close()
                    self._open()
                    turn.then(self._segment)
                    batches[0] = None, frames
                self._write(frames)
                del batches[0]
        except Exception as error:  # noqa: BLE001  neither lack of memory nor a defect may end the thread
            self._fail(error, batches)
        finally:
            self.busy_since = None

    def _write(self, frames: list[bytes]) -> None:
        """Appends whole records; first rotates if the segment is full or the clock was set."""
        if frames and (self._good > self._segment_bytes or self._clock_was_set()):
            self._close()
            self._open()
        data = self._gap() + b"".join(frames)
        _write_all(self._file, data)
        self._good += len(data)
        self.bytes += len(data)
        self.records += len(frames)
        self._noted = self.lost
        self._dirty |= bool(data)
        if self._dirty and time.monotonic() - self._synced_at >= SYNC_S:
            os.fdatasync(self._file)
            self._synced_at, self._dirty = time.monotonic(), False
        if self.error:
            log.warning("recording continues in %s; %d records were lost", self.folder, self.lost)
            self.error = ""

    def _clock_was_set(self) -> bool:
        """True if UTC differs from the segment head by more than :data:`STEP_S`."""
        if self._clock is None or time.monotonic() - self._stepped_at < STEP_AGAIN_S:
            return False
        t_mono, utc = both(self._clock)
        if abs(utc - t_mono - self._ahead) <= STEP_S:
            return False
        self._stepped_at = time.monotonic()
        return True

    def _gap(self) -> bytes:
        """Returns a note record for missing records; empty if none are missing."""
        if self._noted == self.lost:
            return b""
        note = f"{self.lost - self._noted} records before this one were lost: {self.error or 'the disk is too slow'}"
        return pack_frame(Kind.NOTE, 0, self._t_mono, note.encode())

    def _fail(self, error: Exception, batches: list[Batch]) -> None:
        reason = reason_of(error)
        if not self.error:
            line = "recording to %s has stopped: %s; it continues when the folder can be written again"
            log.error(line, self.folder, reason, exc_info=defect_in(error))
        self.error = f"{self.folder}: {reason}"
        self._lose(batches)
        self._close()
        self._retry_at = time.monotonic() + RETRY_S

    def _lose(self, batches: list[Batch]) -> None:
        with self._lock:
            self.lost += sum(len(frames) for _, frames in batches)
        for turn, _ in batches:
            if turn is not None:
                turn.then(None)

    def _open(self) -> None:
        """Starts the next segment with its own head."""
        self._segment += 1
        self.folder.mkdir(parents=True, exist_ok=True)  # the folder may have been deleted meanwhile
        for name in list(self._beside):
            write_whole(self.folder / name, self._beside[name])
            del self._beside[name]
        path = self.folder / segment_name(self._segment)
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        head = pack_head({**self._header, **self._now(), "segment": self._segment})
        self._good = 0
        _write_all(self._file, head)
        os.fdatasync(self._file)  # before its name: a power cut must not leave a segment without a head
        self._good = len(head)
        sync_folder(self.folder)

    def _now(self) -> dict[str, tuple[float, float]]:
        """Returns the times for a segment head, s."""
        if self._clock is None:
            return {}
        t_mono, utc = both(self._clock)
        self._ahead = utc - t_mono
        return {CLOCK: (t_mono, utc)}

    def _close(self) -> None:
        """Truncates a partly written record, syncs and closes; removes a segment without a whole head."""
        if self._file < 0:
            return
        file, self._file = self._file, -1
        try:
            if self._good == 0:
                (self.folder / segment_name(self._segment)).unlink(missing_ok=True)
            os.ftruncate(file, self._good)
            os.fdatasync(file)
        except OSError as error:
            log.warning("segment %d in %s may end within a record: %s", self._segment, self.folder, error.strerror)
        finally:
            os.close(file)
        if self._good:
            self.closed(self._segment, self.folder / segment_name(self._segment))


Batch = tuple[Turn | None, list[bytes]]
"""Start of a new segment, if any, and the records that follow it."""


def _batches(ready: list[bytes | Turn]) -> list[Batch]:
    batches: list[Batch] = [(None, [])]
    for one in ready:
        if isinstance(one, Turn):
            batches.append((one, []))
        else:
            batches[-1][1].append(one)
    return batches


def _nobody(segment: int, path: Path) -> None:
    """Ignores a complete segment; default of :attr:`SegmentWriter.closed`."""


def _write_all(file: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(file, view) :]


def _new_folder(parent: Path, name: str) -> Path:
    """Makes a folder that did not exist before; a clock that is not set yet may give the same time twice."""
    for number in range(1, 10_000):
        folder = parent / (name if number == 1 else f"{name}-{number}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        return folder
    raise FileExistsError(f"{parent / name} and all its numbered successors exist")
