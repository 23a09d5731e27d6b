"""Stall watch: when no cycle begins for two periods, logs what the loop thread was doing and waiting for.

One interval timer of the kernel is restarted at every cycle (about a microsecond); nothing else runs in normal
operation. When it expires, Python calls the handler in the loop thread between two instructions, with the running
frame. Threads that hold the interpreter are found too: the handler then comes late, with the frame that waited.
"""

from __future__ import annotations

import asyncio
import logging
import os
import signal
import sys
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Final

from daemon.system.processor_wait import ProcessorWait

log = logging.getLogger(__name__)

AGAIN_S: Final = 10.0
"""Minimum interval between two log lines on stalls, s; all stalls are counted."""
SHARE: Final = 0.5
"""Share of a stall that a single cause must make up to be named."""
MUCH_S: Final = 0.01
"""Handler delay, s, above which the loop thread was held up; a loop at rest handles the signal sooner."""
OWN: Final = Path(__file__).resolve().parents[2]
DEEP: Final = 3
"""Number of our innermost functions that are named."""
IDLE: Final = ("select", "wait", "get", "_wait_for_tstate_lock", "sleep", "poll")
"""Functions in which a thread waits without delaying others."""


@dataclass(frozen=True, slots=True)
class Caught:
    """State at the expiry of the timer.

    Attributes:
        where: functions that the loop thread was in, empty: at rest. task: name of its task.
        others: other active threads, and their functions. late: delay of the handler in the loop thread, s.
    """

    where: str
    task: str
    others: str
    late: float = 0.0


class StallWatch:
    """Watches the thread that makes it, which must be the main one (signals are handled there).

    Call :meth:`arm` when a cycle begins.

    Attributes:
        said: the latest line, empty before the first stall.
    """

    def __init__(self) -> None:
        self.said = ""
        self._thread = threading.get_ident()
        self._caught: Caught | None = None
        self._armed = self._due = time.monotonic()
        self._cpu = time.thread_time()
        self._wait = ProcessorWait()
        self._kept = self._wait.seconds()
        self._said_at = -AGAIN_S
        self._unsaid = 0
        self._before = signal.signal(signal.SIGALRM, self._ring)

    def arm(self, seconds: float) -> float | None:
        """Restarts the timer of ``seconds`` at the start of a cycle.

        Returns the seconds since the last start if it expired.
        """
        now, cpu = time.monotonic(), time.thread_time()
        caught, self._caught = self._caught, None
        signal.setitimer(signal.ITIMER_REAL, seconds)
        lasted = None
        if caught is not None:
            lasted = now - self._armed
            self._tell(caught, lasted, cpu - self._cpu)
        self._armed, self._due, self._cpu = now, now + seconds, cpu
        self._kept = self._wait.seconds()
        return lasted

    def close(self) -> None:
        """Stops watching; idempotent."""
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        if signal.getsignal(signal.SIGALRM) == self._ring:
            signal.signal(signal.SIGALRM, self._before)
        self._wait.close()

    def _ring(self, number: int, frame: FrameType | None) -> None:
        """Captures the state when the timer expires; never blocks."""
        if self._caught is None:
            late = max(0.0, time.monotonic() - self._due)
            self._caught = Caught(place(frame), _task(), self._others(), late)

    def _others(self) -> str:
        """Returns our other active threads and their functions, as text."""
        names = {thread.ident: thread.name for thread in threading.enumerate()}
        found = []
        for ident, frame in sys._current_frames().items():
            if ident != self._thread and frame.f_code.co_name not in IDLE and (where := place(frame)):
                found.append(f"{names.get(ident, 'a thread')} in {where}")
        return ", ".join(found)

    def _tell(self, caught: Caught, lasted: float, worked: float) -> None:
        now = time.monotonic()
        if now - self._said_at < AGAIN_S:
            self._unsaid += 1
            return
        more = f"; {self._unsaid} more since the previous line" if self._unsaid else ""
        stolen = self._wait.seconds()
        waited = None if stolen is None or self._kept is None else stolen - self._kept
        self.said = f"no cycle began for {lasted:.3f} s: {cause(caught, lasted, worked, waited)}{more}"
        log.info("%s", self.said)  # a long stall is a fault with its own warning
        self._said_at, self._unsaid = now, 0


def cause(caught: Caught, lasted: float, worked: float, waited: float | None) -> str:
    """Returns the cause of a stall: own work, another program, another thread of ours, or a blocking call."""
    task = f" (task {caught.task})" if caught.task else ""
    if worked >= SHARE * lasted:
        return f"{caught.where or 'the loop'}{task} ran for {worked:.3f} s"
    if waited is not None and waited >= SHARE * lasted:
        return f"other programs used the processor for {waited:.3f} s, in {caught.where or 'the loop'}{task}"
    if caught.others and (caught.where or caught.late >= MUCH_S):
        return f"{caught.where or 'the loop'}{task} waited while {caught.others}"
    if not caught.where and caught.late < MUCH_S:
        return "no event arrived, neither a scan nor the timer"
    return f"{caught.where or 'the loop'}{task} waited: a call blocked, or the process was stopped"


def place(frame: FrameType | None) -> str:
    """Returns our innermost functions on the stack, the outer one first; empty if the loop was waiting."""
    names: list[str] = []
    inner = frame
    while inner is not None and len(names) < DEEP:
        code = inner.f_code
        path = Path(code.co_filename)
        if OWN in path.parents and "site-packages" not in path.parts and path.stem != "stall_watch":
            names.append(f"{os.path.relpath(path, OWN).removesuffix('.py').replace('/', '.')}.{code.co_qualname}")
        inner = inner.f_back
    if names and frame is not None and frame.f_code.co_name in ("select", "poll") and _resting(names[0]):
        return ""
    return " > ".join(reversed(names))


def _resting(name: str) -> bool:
    """True if our innermost function is only the one that runs the loop."""
    return name.endswith((".main", ".run", ".<module>"))


def _task() -> str:
    """Returns the name of the running task."""
    try:
        task = asyncio.current_task()
    except RuntimeError:
        return ""
    return "" if task is None else task.get_name()
