"""The flight recorder: when a recording gets a state to be replayed from, and when a dump of it is made.

All of it runs in the loop's thread, at the end of a cycle: it captures the state
(`daemon.recording.checkpoint.capture`) and hands it to the threads that write.
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
"""A recording that is kept as a whole gets a state so often, and with every segment."""
SHARE, LEAST_S = 5.0, 30.0
"""A ring gets so many states in the time that it reaches back; not more often than this, s."""
RETRY_S: Final = 60.0
AFTER_S: Final = 5.0
"""A dump because of a fault shows what became of it for so long."""
AGAIN_S: Final = 300.0
"""The same fault makes another dump after so long."""
ASKED_AGAIN_S: Final = 10.0
"""Whoever asks for dumps gets another after so long: each costs a cycle the taking of a state."""
JOBS: Final = 64
"""Beyond so many jobs under way those are looked for that nobody waits for."""
UNASKED: Final = 16
"""Jobs that the estimator waits for no longer, but that may still answer."""
UNDER_WAY: Final = "another dump is just being made"
QUIET: Final = frozenset((Fault.RECORDER_FAILED, Fault.FLIGHT_RECORDER_FAILED))
"""Faults that a dump cannot tell anything about."""


class Line:
    """What a lidar's line has said that whoever joins later must know: how it was opened, and the latest scans.

    A piece of bytes may end a scan, several of them, or none: the last three that end some are kept, with all since.
    """

    OPENING_BYTES: Final = 64 << 10
    LATEST_BYTES: Final = 512 << 10
    ENDS: Final = 3

    def __init__(self) -> None:
        self._opening: list[bytes] = []
        self._latest: deque[tuple[bytes, bool]] = deque()  # frames, and whether a scan has ended with them
        self._streaming = False
        self._ends = self._opening_bytes = self._latest_bytes = 0

    def passed(self, kind: Kind, t_mono: float, payload: bytes) -> None:
        """Something passed through the port."""
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
        """A scan was complete with what has just passed."""
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
        """All of it, as records."""
        gap = [pack_frame(Kind.LOST, 0, 0.0, b"what is between is left out")] if self._latest else []
        return b"".join((*self._opening, *gap, *(frame for frame, _ in self._latest)))


class BlackBox:
    """Looks after the states and dumps of one recording.

    Attributes:
        line: of the lidar. error: why the latest state could not be taken; empty while all is well.
        take_s: seconds that taking the latest state took.
    """

    def __init__(self, disk: SegmentWriter, clock: Clock, header: dict[str, Any], keep_s: float = math.inf) -> None:
        """``keep_s``: how far back the recording reaches; infinite: as far as there is room."""
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
        """What of states and dumps cannot be kept at the moment, empty while all is well."""
        return self.error or self.flight.error

    def attach(
        self, cycle: Cycle, state: Callable[[], State | None], faults: Callable[[], tuple[Fault, ...]] = tuple
    ) -> None:
        """Say what is recorded. ``state``: the estimator's, None before it is loaded. ``faults``: that are present."""
        self._cycle, self._state, self._faults = cycle, state, faults

    def on_cycle(self, record: CycleRecord) -> None:
        """A cycle has ended and is recorded; nothing that comes from now on belongs to it. Never raises."""
        try:
            self._look(record)
        except Exception as error:  # a defect in here must not end the cycle; it is a fault, and told in full
            if not self.error:
                log.exception("the flight recorder has failed")
            self.error = repr(error)
            self._due = record.t_mono + RETRY_S

    def _look(self, record: CycleRecord) -> None:
        """Follow the jobs and the faults; take a state, or make a dump, where it is due."""
        self._follow_jobs(record)
        now = record.t_mono
        if record.cycle == 1:
            self.flight.prepare()
        if self._gap and not self._disk.error:  # what comes after a gap replays from a state alone
            self._due = now
        self._gap = bool(self._disk.error)
        if self._ring:  # what is kept as a whole needs no dumps
            self._watch_faults(now)
        if self._pending is not None and now >= self._pending[0]:
            (_, fault), self._pending = self._pending, None
            self._dump(*_of_fault(fault), _said)
        elif now >= self._due or self._disk.taken - self._bytes > SEGMENT_BYTES:
            if self._disk.taken - self._bytes >= self.flight.state_bytes:  # large maps: at most half is states
                self._begin(_nothing)
            else:
                self._due = now + self._every_s

    def dump(self, on_done: OnDone) -> None:
        """Make a dump of what there is, now; ``on_done`` in this thread when it is there, or why not.

        One at a time, each holds a state until the disk has it; and another only after :data:`ASKED_AGAIN_S`.
        """
        now, loop = self._clock.now(), asyncio.get_running_loop()
        if self._asked:
            on_done(UNDER_WAY)
            return
        if now < self._ask_from:
            on_done(f"one was made a moment ago; another can be made in {self._ask_from - now:.0f} s")
            return

        def end(reason: str) -> None:
            self._asked = False
            on_done(reason)

        def back(reason: str) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has closed: nobody waits any more
                loop.call_soon_threadsafe(end, reason)

        self._asked, self._ask_from = True, now + ASKED_AGAIN_S
        try:
            self._dump(ASKED, "somebody has asked for it", back)
        except Exception as error:  # a defect in here must not leave the client waiting, and is told in full
            log.exception("the flight recorder has failed")
            end(repr(error))

    def close(self, ended: bool) -> None:
        """Finish what is under way; after the disk.

        A dump that was to wait for what becomes of its fault waits no longer: what was recorded goes with the next
        start. It needs no state of its own, for nothing comes after it.
        """
        if self._pending is not None:
            (_, fault), self._pending = self._pending, None
            self.flight.dump(self._about(*_of_fault(fault)), _said)
        self.flight.close(ended)

    def _follow_jobs(self, record: CycleRecord) -> None:
        """Keep the jobs that may still answer."""
        if record.limits is not None and record.result is not None and record.result.jobs:
            self._jobs.update((job.job_id, job) for job in record.result.jobs)
            if len(self._jobs) > JOBS and (state := self._state()) is not None:
                self._let_go(state)
        for job_id in record.answers:
            self._jobs.pop(job_id, None)

    def _let_go(self, state: State) -> None:
        """Forget the jobs that nobody waits for any more, but the latest: they hold what they are about."""
        unasked = [job_id for job_id in self._jobs if job_id not in state.jobs.pending]
        for job_id in unasked[:-UNASKED]:
            del self._jobs[job_id]

    def _watch_faults(self, now: float) -> None:
        faults = frozenset(self._faults())
        if faults == self._present:
            return
        new, self._present = faults - self._present - QUIET, faults
        for fault in sorted(new):
            if self._pending is None and now - self._dumped.get(fault, -math.inf) >= AGAIN_S:
                self._pending = now + AFTER_S, fault
                self._dumped[fault] = now

    def _begin(self, then: Callable[[int | None], None]) -> None:
        """Begin a segment with the state of this moment."""
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
        """In the writing thread: the segment has its number. ``now``: by both clocks, s, when its state was taken."""
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
                log.error("flight recorder: %s; what is recorded replays from an older state", error)
            self.error = str(error)
            return None
        self.take_s = time.perf_counter() - begun
        self.error = ""
        return taken

    def _about(self, reason: str, why: str) -> dict[str, Any]:
        """What a dump says of itself."""
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
                on_done("nothing can be written at the moment")
            else:
                self.flight.dump(about, on_done)

        self._begin(then)


def _of_fault(fault: Fault) -> tuple[str, str]:
    """Reason of a dump because of a fault, and what the fault means."""
    return f"fault-{int(fault)}", FAULTS[fault][0]


def _none() -> None:
    """There is no state yet."""


def _nothing(segment: int | None) -> None:
    """Nobody waits for the segment."""


def _said(reason: str) -> None:
    """Nobody waits for the dump."""
