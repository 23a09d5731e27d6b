"""Flight recorder: decides when a recording gets a checkpoint, and when a dump of it is made.

All of it runs in the loop thread at the end of a cycle. It captures the state
(`daemon.recording.checkpoint.capture`) and passes it to the threads that write.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import re
import time
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from daemon.health.causes import cause_of
from daemon.health.faults import FAULTS, Fault
from daemon.recording.disk_writer import CLOCK, SEGMENT_BYTES, SegmentWriter, both
from daemon.recording.replay_start import CYCLE_PARTS
from daemon.recording.retention import ASKED, Begun, Flight
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import CycleRecord
from daemon.system.callbacks import OnDone
from estimator import Job
from hal.clock import Clock
from hal.replay.recording import Kind, pack_frame

if TYPE_CHECKING:  # the estimator is loaded in a thread, by the warm-up
    from daemon.recording.checkpoint import Taken
    from estimator import State

log = logging.getLogger(__name__)

EVERY_S: Final = 600.0
"""Checkpoint interval of a recording that is kept whole, s; every segment adds one."""
SHARE, LEAST_S = 5.0, 30.0
"""Checkpoints of a ring within the time that it keeps; and their minimum interval, s."""
RETRY_S: Final = 60.0
AFTER_S: Final = 5.0
"""Time after a fault that its dump still covers, s."""
AGAIN_S: Final = 300.0
"""Minimum interval between two dumps of the same fault, s."""
ASKED_AGAIN_S: Final = 10.0
"""Minimum interval between two requested dumps, s; each costs a cycle the capture of a state."""
JOBS: Final = 64
"""Number of pending jobs above which jobs without a recipient are removed."""
UNASKED: Final = 16
"""Jobs kept although the estimator waits for them no longer; they may still give a result."""
UNDER_WAY: Final = "another dump is being written"
QUIET: Final = frozenset((Fault.RECORDER_FAILED, Fault.FLIGHT_RECORDER_FAILED))
"""Faults on which a dump has no information."""


class Line:
    """Bytes of the lidar line that a replay from the middle needs: the opening exchange and the latest scans.

    A chunk of bytes may complete one scan, several or none. The last three chunks that complete a scan are kept, with
    all bytes since.
    """

    OPENING_BYTES: Final = 64 << 10
    LATEST_BYTES: Final = 512 << 10
    ENDS: Final = 3

    def __init__(self) -> None:
        self._opening: list[bytes] = []
        self._latest: deque[tuple[bytes, bool]] = deque()  # records, and whether each completed a scan
        self._streaming = False
        self._ends = self._opening_bytes = self._latest_bytes = 0

    def passed(self, kind: Kind, t_mono: float, payload: bytes) -> None:
        """Records bytes or an event of the port."""
        frame = pack_frame(kind, 0, t_mono, payload)
        if kind in (Kind.OPEN, Kind.LOST):
            self._opening, self._streaming = [], False
            self._latest.clear()
            self._ends = self._opening_bytes = self._latest_bytes = 0
        if self._streaming:
            self._latest.append((frame, False))
            self._latest_bytes += len(frame)
            while self._latest_bytes > self.LATEST_BYTES:
                self._drop()
        elif self._opening_bytes + len(frame) <= self.OPENING_BYTES:
            self._opening.append(frame)
            self._opening_bytes += len(frame)

    def scan(self) -> None:
        """Marks that the latest bytes completed a scan."""
        self._streaming = True
        if self._latest and not self._latest[-1][1]:
            self._latest[-1] = self._latest[-1][0], True
            self._ends += 1
            while self._ends > self.ENDS or not self._latest[0][1]:
                self._drop()

    def _drop(self) -> None:
        frame, ended = self._latest.popleft()
        self._latest_bytes -= len(frame)
        self._ends -= ended

    def said(self) -> bytes:
        """Returns all kept bytes, as records."""
        gap = [pack_frame(Kind.LOST, 0, 0.0, b"what is between is left out")] if self._latest else []
        return b"".join((*self._opening, *gap, *(frame for frame, _ in self._latest)))


class BlackBox:
    """Makes the checkpoints and dumps of one recording.

    Attributes:
        line: of the lidar. error: why the latest capture failed; empty without trouble.
        take_s: duration of the latest capture, s.
    """

    def __init__(self, disk: SegmentWriter, clock: Clock, header: dict[str, Any], keep_s: float = math.inf) -> None:
        """``keep_s``: how far back the recording reaches, s; infinite: as far as the disk has room."""
        self.line = Line()
        self.error = ""
        self.take_s = 0.0
        self.flight: Final = Flight(disk.folder, keep_s)
        disk.closed = self.flight.closed
        self._disk, self._clock, self._header = disk, clock, header
        self._every_s = EVERY_S if math.isinf(keep_s) else max(LEAST_S, keep_s / SHARE)
        self._ring = not math.isinf(keep_s)
        self._gap = False
        self._bytes = 0
        self._due = clock.now() + self._every_s
        self._cycle: Cycle | None = None
        self._state: Callable[[], State | None] = _none
        self._faults: Callable[[], tuple[Fault, ...]] = tuple
        self._jobs: dict[int, Job] = {}
        self._present: frozenset[Fault] = frozenset()
        self._dumped: dict[Fault, float] = {}
        self._pending: tuple[float, Fault] | None = None
        self._asked = False
        self._ask_from = -math.inf

    @property
    def failing(self) -> str:
        """Why checkpoints or dumps cannot be stored at present; empty without trouble."""
        return self.error or self.flight.error

    def attach(
        self, cycle: Cycle, state: Callable[[], State | None], faults: Callable[[], tuple[Fault, ...]] = tuple
    ) -> None:
        """Sets the sources. ``state``: estimator state, None before it is loaded. ``faults``: those present."""
        self._cycle, self._state, self._faults = cycle, state, faults

    def on_cycle(self, record: CycleRecord) -> None:
        """Processes the end of a recorded cycle; later input does not belong to it. Never raises."""
        try:
            self._look(record)
        except Exception as error:  # a defect here must not end the cycle; it becomes a fault and is logged in full
            if not self.error:
                log.exception("the flight recorder has failed")
            self.error = repr(error)
            self._due = record.t_mono + RETRY_S

    def _look(self, record: CycleRecord) -> None:
        """Updates pending jobs and faults; makes a checkpoint or a dump where one is due."""
        self._follow_jobs(record)
        now = record.t_mono
        if record.cycle == 1:
            self.flight.prepare()
        if self._gap and not self._disk.error:  # after a gap, a replay can start only from a checkpoint
            self._due = now
        self._gap = bool(self._disk.error)
        if self._ring:  # a recording that is kept whole needs no dumps
            self._watch_faults(now)
        if self._pending is not None and now >= self._pending[0]:
            (_, fault), self._pending = self._pending, None
            self._dump(*_of_fault(fault), _said)
        elif now >= self._due or self._disk.taken - self._bytes > SEGMENT_BYTES:
            if self._disk.taken - self._bytes >= self.flight.state_bytes:  # large maps: at most half is checkpoints
                self._begin(_nothing)
            else:
                self._due = now + self._every_s

    def dump(self, on_done: OnDone) -> None:
        """Makes a dump now; calls ``on_done`` in this thread with an empty text, or with the reason of a failure.

        Only one dump is made at a time, because each holds a state until it is on the disk. The next one is allowed
        after :data:`ASKED_AGAIN_S`.
        """
        now, loop = self._clock.now(), asyncio.get_running_loop()
        if self._asked:
            on_done(UNDER_WAY)
            return
        if now < self._ask_from:
            on_done(f"the last dump is too recent; another is possible in {self._ask_from - now:.0f} s")
            return

        def end(reason: str) -> None:
            self._asked = False
            on_done(reason)

        def back(reason: str) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has closed: there is no client any more
                loop.call_soon_threadsafe(end, reason)

        self._asked, self._ask_from = True, now + ASKED_AGAIN_S
        try:
            self._dump(ASKED, "a client has requested it", back)
        except Exception as error:  # a defect here must not leave the client waiting; it is logged in full
            log.exception("the flight recorder has failed")
            end(repr(error))

    def close(self, ended: bool) -> None:
        """Finishes pending work; called after the disk writer has closed.

        The next start removes the ring. A dump that still waits for the time after its fault is therefore made at once.
        It needs no checkpoint of its own, since nothing follows it.
        """
        if self._pending is not None:
            (_, fault), self._pending = self._pending, None
            self.flight.dump(self._about(*_of_fault(fault)), _said)
        self.flight.close(ended)

    def _follow_jobs(self, record: CycleRecord) -> None:
        """Keeps the jobs that may still give a result."""
        if record.limits is not None and record.result is not None and record.result.jobs:
            self._jobs.update((job.job_id, job) for job in record.result.jobs)
            if len(self._jobs) > JOBS and (state := self._state()) is not None:
                self._let_go(state)
        for job_id in record.answers:
            self._jobs.pop(job_id, None)

    def _let_go(self, state: State) -> None:
        """Removes jobs without a recipient, except the latest ones; jobs keep their input data alive."""
        unasked = [job_id for job_id in self._jobs if job_id not in state.jobs.pending]
        for job_id in unasked[:-UNASKED]:
            del self._jobs[job_id]

    def _watch_faults(self, now: float) -> None:
        faults = frozenset(self._faults())
        if faults == self._present:
            return
        new, self._present = faults - self._present - QUIET, faults
        for fault in sorted(fault for fault in new if not cause_of(fault, faults)):
            if self._pending is None and now - self._dumped.get(fault, -math.inf) >= AGAIN_S:
                self._pending = now + AFTER_S, fault
                self._dumped[fault] = now

    def _begin(self, then: Callable[[int | None], None]) -> None:
        """Begins a segment with a checkpoint of the present state."""
        now, utc = both(self._clock)
        taken = self._take()
        self._due = now + (RETRY_S if taken is None else self._every_s)
        self._bytes = self._disk.taken
        cycle = 0 if self._cycle is None else self._cycle.cycles
        line = self.line.said()
        self._disk.begin(partial(self._begun, (now, utc), taken, line, cycle, then))

    def _begun(
        self,
        now: tuple[float, float],
        taken: Taken | None,
        line: bytes,
        cycle: int,
        then: Callable[[int | None], None],
        segment: int | None,
    ) -> None:
        """Queues the checkpoint once the segment has its number; writing thread. ``now``: both clocks at capture, s."""
        if segment is not None:
            header = {**self._header, "segment": segment, "t_state": now[0], CLOCK: now, "cycle": cycle}
            self.flight.begun(Begun(segment, now[0], taken, line, header))
        then(segment)

    def _take(self) -> Taken | None:
        cycle, state = self._cycle, self._state()
        if cycle is None or state is None:
            return None
        self._let_go(state)
        samples, blocks = cycle.parts.samples, cycle.parts.blocks
        rest: dict[str, object] = {
            "cycle": {name: getattr(cycle, name) for name in CYCLE_PARTS},
            "jobs": dict(self._jobs),
            "samples": None if samples is None else dict(vars(samples)),
            "blocks": None if blocks is None else {**vars(blocks), "status": None},
        }
        from daemon.recording.checkpoint import CannotTake, capture

        begun = time.perf_counter()
        try:
            taken = capture(state, rest)
        except CannotTake as error:
            if not self.error:
                log.error("flight recorder: %s; the recording replays from an older checkpoint", error)
            self.error = str(error)
            return None
        self.take_s = time.perf_counter() - begun
        self.error = ""
        return taken

    def _about(self, reason: str, why: str) -> dict[str, Any]:
        """Returns the metadata of a dump."""
        t_mono, t_utc = both(self._clock)
        return {
            "reason": re.sub(r"[^a-z0-9-]", "-", reason),
            "why": why,
            "at": f"{datetime.fromtimestamp(t_utc, UTC):%Y-%m-%dT%H-%M-%SZ}",
            "t_mono": t_mono,
            "t_utc": t_utc,
            "faults": [int(fault) for fault in sorted(self._present)],
        }

    def _dump(self, reason: str, why: str, on_done: OnDone) -> None:
        about = self._about(reason, why)

        def then(segment: int | None) -> None:
            if segment is None:
                on_done("the recorder cannot write at present")
            else:
                self.flight.dump(about, on_done)

        self._begin(then)


def _of_fault(fault: Fault) -> tuple[str, str]:
    """Returns the reason text of a dump after a fault, and the meaning of the fault."""
    return f"fault-{int(fault)}", FAULTS[fault][0]


def _none() -> None:
    """No estimator state yet."""


def _nothing(segment: int | None) -> None:
    """Ignores the number of the segment."""


def _said(reason: str) -> None:
    """Ignores the result of the dump."""
