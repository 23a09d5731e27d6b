"""Programs that a benchmark starts: each has to speak or to end within its time, and none outlives the benchmark."""

import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final

LEASH: Final = ("setpriv", "--pdeathsig", "KILL")
"""Before the words of a program: it ends with the one that started it, however that ends."""
ROOT: Final = Path(__file__).parents[3]
SILENT_S: Final = 120.0
"""From one line of a program to its next: a stretch takes 10 s, a start with compiled kernels a few, on a busy machine
ten times that."""
END_S: Final = 30.0


class CannotRun(RuntimeError):
    """What is needed is not there, or does not do in time what it is there for."""


@contextmanager
def child(*words: str, ask: bool = False, hear: bool = False, mute: bool = False) -> Iterator[subprocess.Popen[bytes]]:
    """A program beside this one, killed with the block, or with this process.

    ``ask``, ``hear``: pipes to it and from it. ``mute``: nobody hears it at all.
    """
    pipe, none = subprocess.PIPE, subprocess.DEVNULL
    words, said = (*LEASH, *words), none if mute else None
    with subprocess.Popen(
        words, cwd=ROOT, stdin=pipe if ask else none, stdout=pipe if hear else said, stderr=said
    ) as started:
        try:
            yield started
        finally:
            started.kill()


def lines(started: subprocess.Popen[bytes], what: str, patience_s: float | None = None) -> Iterator[str]:
    """What it says, line by line, until it closes its output.

    Raises:
        CannotRun: it says nothing for ``patience_s`` (default: `SILENT_S`).
    """
    assert started.stdout is not None
    patience, rest = SILENT_S if patience_s is None else patience_s, bytearray()
    end = time.monotonic() + patience
    while True:
        if not select.select([started.stdout], [], [], max(end - time.monotonic(), 0.0))[0]:
            raise CannotRun(f"{what} has said nothing for {patience:g} s: it was ended; is the computer too busy?")
        part = os.read(started.stdout.fileno(), 1 << 16)
        if not part:
            return
        rest += part
        if b"\n" in part:
            *whole, last = rest.split(b"\n")
            rest = bytearray(last)
            yield from (line.decode() for line in whole)
            end = time.monotonic() + patience  # not counted: what whoever listens does with them


def ended(started: subprocess.Popen[bytes], what: str, patience_s: float | None = None) -> int:
    """Its exit code.

    Raises:
        CannotRun: it goes on for more than ``patience_s`` (default: `END_S`).
    """
    patience = END_S if patience_s is None else patience_s
    try:
        return started.wait(patience)
    except subprocess.TimeoutExpired as late:
        raise CannotRun(f"{what} has not ended within {patience:g} s: it was killed") from late


def two_counts(started: subprocess.Popen[bytes], what: str) -> tuple[int, int]:
    """Tell it to end (SIGTERM); the two numbers that it says then.

    Raises:
        CannotRun: it goes on for more than `END_S`, or has said something else.
    """
    started.terminate()
    try:
        said = started.communicate(timeout=END_S)[0].split()
        first, second = map(int, said)
    except subprocess.TimeoutExpired as late:
        raise CannotRun(f"{what} were told to end and have not within {END_S:g} s: they were killed") from late
    except ValueError as error:
        raise CannotRun(f"{what} ended before their time, with code {started.returncode}") from error
    return first, second


def finished(words: Sequence[str], what: str, seconds: float) -> subprocess.CompletedProcess[str]:
    """A program run to its end, with all that it starts itself, as a compiler does.

    Raises:
        CannotRun: it takes longer than ``seconds``.
    """
    pipe, words = subprocess.PIPE, [*LEASH, *words]
    with subprocess.Popen(
        words, stdin=subprocess.DEVNULL, stdout=pipe, stderr=pipe, text=True, start_new_session=True
    ) as started:
        try:
            said, wrong = started.communicate(timeout=seconds)
        except BaseException as early:
            with suppress(ProcessLookupError):
                os.killpg(started.pid, signal.SIGKILL)  # who else is in it would keep the pipes open
            if isinstance(early, subprocess.TimeoutExpired):
                raise CannotRun(f"{what} has not ended within {seconds:g} s: it was killed") from early
            raise
    return subprocess.CompletedProcess(words, started.returncode, said, wrong)
