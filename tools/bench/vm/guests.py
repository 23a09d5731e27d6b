"""Several emulated computers at once, each with its share of the scenarios, in a thread of its own."""

from __future__ import annotations

import contextlib
import signal
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

from tools.bench.report.result import Figure, Result, Seen
from tools.bench.vm.bench import Bench, bench
from tools.bench.vm.booted import Booted
from tools.bench.vm.common import AFTER, Scenario, Unmet, unnoticed
from tools.bench.vm.machine import Order
from tools.bench.vm.places import BrokenOff, CannotBench

JOURNAL: Final = ("journalctl", "--no-pager", "-o", "short-monotonic", "-n", "3000")
BEHIND: Final = {2: 5, 3: 2}
"""Which computer stands back (nice(1)): the first one drives; the third one has most to do."""
LONGEST: Final = 3
"""The computer that has most to do is the first to be switched on."""
SIDE_BY_SIDE: Final = 2
"""So many computers of three, where the emulation is slow: a third one would starve them of their two processors."""
SLOW: Final = 2.5
"""From so many times the usual seconds for the same work. At 2.3 three side by side were all right."""
LOOK_S: Final = 0.1
Say = Callable[[str], None]


def title(scenario: Scenario) -> str:
    """Its first line."""
    return (scenario.__doc__ or scenario.__name__).splitlines()[0].rstrip(".")


def not_run(scenario: Scenario, why: str) -> Result:
    """One that has not been tried, which is not to have passed."""
    return Result(scenario.__name__, title(scenario), False, 0.0, "", skipped=f"not run: {why}")


def tried(scenario: Scenario, bench: Bench) -> Result:
    """One scenario's result.

    Raises:
        CannotBench, BrokenOff: the emulated computer has ended, or is to.
    """
    begun = time.monotonic()
    try:
        told, passed = scenario(bench), True
        seen = told if isinstance(told, Seen) else Seen(told)
    except (CannotBench, BrokenOff):
        raise
    except Unmet as error:
        seen, passed = replace(error.seen, said=f"{error}"), False
    except LookupError as error:
        seen, passed = Seen(f"what it builds on has not been seen: {error!r}"), False
    except (Order, OSError, ValueError, StopIteration) as error:
        seen, passed = Seen(f"{error}" or repr(error)), False
    except Exception:  # noqa: BLE001  a mistake in one scenario is no reason to lose what the others have shown
        seen, passed = Seen(traceback.format_exc()), False
    lost = _lost(scenario, bench)
    if lost:
        seen, passed = replace(seen, said=f"{lost}\n{seen.said}"), False
    seconds = time.monotonic() - begun
    name = scenario.__name__
    return Result(name, title(scenario), passed, seconds, seen.said, figures=seen.figures, plots=seen.plots)


def _lost(scenario: Scenario, bench: Bench) -> str:
    try:
        return unnoticed(bench, AFTER[scenario])
    except (Order, OSError, LookupError, ValueError) as error:
        return f"what has become of the daemon is not known: {error}"


def _with_work(scenario: Scenario, whole: Bench) -> Result:
    """One scenario's result, with what the emulation has worked for it."""
    before = whole.machine.worked_s()
    one = tried(scenario, whole)
    after = whole.machine.worked_s()
    if before is None or after is None:
        return one
    return replace(one, figures=(*one.figures, Figure("work of the emulation", after - before, "CPU s")))


@dataclass(slots=True)
class Guest:
    """One emulated computer, its share, and what has come of it so far.

    ``slower``: than usual by so many times, known once it is up.
    """

    number: int
    share: list[Scenario]
    results: list[Result] = field(default_factory=list)
    slower: float | None = None
    broken_off: threading.Event = field(default_factory=threading.Event)

    def run(self, booted: Booted, folder: Path, out: Path, say: Say) -> None:
        """Try them, until it ends or is broken off; its console, its journal and its drive stay in ``out``."""
        why = "the bench has met an error of its own, which it has written"
        try:
            folder.mkdir()
            with ExitStack() as stack:
                nice = BEHIND.get(self.number, 0)
                whole = stack.enter_context(bench(booted, folder, self.broken_off, nice))
                for scenario in self.share:
                    whole.machine.check()
                    self.results.append(_with_work(scenario, whole))
                    self._tell(self.results[-1], say)
                    self.slower = whole.slower
                with contextlib.suppress(Order, OSError):
                    (out / f"journal-{self.number}.log").write_text(whole.machine.run(*JOURNAL, seconds=120))
        except BrokenOff:
            why = "the run was broken off"
        except CannotBench as reason:
            if len(self.results) < len(self.share):
                one = self.share[len(self.results)]
                self.results.append(Result(one.__name__, title(one), False, 0.0, f"{reason}"))
                self._tell(self.results[-1], say)
            why = "the emulated computer had ended"
        finally:
            self._leave(why, say)
            for name in ("console", "qemu", "world", "drive"):
                if (folder / name).exists():
                    (out / f"{name}-{self.number}.log").write_bytes((folder / name).read_bytes())

    def _leave(self, why: str, say: Say) -> None:
        for one in self.share[len(self.results) :]:
            self.results.append(not_run(one, why))
            self._tell(self.results[-1], say)

    def _tell(self, one: Result, say: Say) -> None:
        say(f"{self.number}: {one.outcome:7} {one.seconds:6.1f} s  {one.title}\n{' ' * 21}{one.skipped or one.said}")


def run_all(guests: list[Guest], booted: Booted, folder: Path, out: Path, say: Say) -> bool:
    """Run them side by side; what they show is in them. False: somebody has broken it off (SIGINT, SIGTERM).

    Where the emulation is found to be slow, no more than `SIDE_BY_SIDE` run at once: what a computer leaves undone for
    want of its processor would be told of the daemon in it.
    """
    broken_off = threading.Event()

    def break_off(number: int, frame: object) -> None:
        for one in before:  # a second one in the middle of this would wait for ever for what the first one holds
            signal.signal(one, signal.SIG_IGN)
        say("broken off: the emulated computers are switched off, and what they have shown is reported")
        for event in (broken_off, *(guest.broken_off for guest in guests)):
            event.set()

    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    for number in before:
        signal.signal(number, break_off)
    try:
        threads: list[threading.Thread] = []
        for one in sorted(guests, key=lambda one: one.number != LONGEST):
            _wait_for_room(guests, threads, say)
            words = (booted, folder / str(one.number), out, say)
            threads.append(threading.Thread(target=one.run, args=words))
            threads[-1].start()
        for thread in threads:
            thread.join()
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    return not broken_off.is_set()


def _wait_for_room(guests: list[Guest], threads: list[threading.Thread], say: Say) -> None:
    """Until one more may run: fewer than `SIDE_BY_SIDE` do, or those that run are found to be fast enough."""
    told = False
    while sum(thread.is_alive() for thread in threads) >= SIDE_BY_SIDE:
        known = [guest.slower for guest in guests if guest.slower is not None]
        if len(known) >= SIDE_BY_SIDE and max(known) <= SLOW:
            return
        if known and max(known) > SLOW and not told:
            say(f"the emulation is {max(known):.1f} times slower than usual: {SIDE_BY_SIDE} computers at a time")
            told = True
        time.sleep(LOOK_S)
