"""Feeds a parser damaged bytes by the megabyte, and measures what that does: stalls, memory, lines reached.

Damage is done to well-formed inputs and to the corpus: what a search for new lines once found (`tests/fuzz/corpus`,
see `tests/fuzz/__main__.py`). Every storm is the same for the same seed.
"""

from __future__ import annotations

import gc
import random
import sys
import time
import tracemalloc
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

CORPUS: Final = Path(__file__).parent / "corpus"
LONGEST: Final = 1 << 16
STALL_S: Final = 1.0
GROWTH: Final = 1 << 20
TRACED: Final = 0.1
"""Share of the bytes during which every allocation is counted; that takes several times as long."""

NUMBERS: Final = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0xFFFF, 0xFFFFF, 0x7FFFFFFF, 0xFFFFFFFF)
WORDS: Final = (
    b"\n",
    b"\n\n",
    b"nan",
    b"-1",
    b"1e999",
    b"inf",
    b"\0",
    b"\xff\xff",
    b"=",
    b"[",
    b"]]",
    b'"',
    b"#",
    b"9" * 30,
)


@dataclass(frozen=True, slots=True)
class Outcome:
    """What a storm has shown.

    Attributes:
        inputs, fed: their number, and bytes. worst_s: the longest processor time of one input.
        growth: bytes that the parser would keep of the whole storm, kept as of its last part.
    """

    inputs: int
    fed: int
    worst_s: float
    growth: int


def corpus(name: str) -> list[bytes]:
    """What is kept for a target."""
    return [file.read_bytes() for file in sorted((CORPUS / name).glob("*"))]


def damaged(data: bytes, others: Sequence[bytes], chance: random.Random) -> bytes:
    """Some of what happens to bytes: flips, losses, repetitions, foreign parts, extreme numbers and words, cuts."""
    found = bytearray(data)
    for _ in range(chance.choice((0, 1, 1, 2, 3, 8))):
        at = chance.randrange(len(found) + 1)
        span = chance.randint(1, chance.choice((1, 4, 20, 200)))
        kind = chance.randrange(9)
        if kind == 0 and at < len(found):
            found[at] ^= 1 << chance.randrange(8)
        elif kind == 1:
            found[at : at + span] = chance.randbytes(span)
        elif kind == 2:
            del found[at : at + span]
        elif kind == 3:
            found[at:at] = found[at : at + span] * chance.choice((1, 1, 5, 50))
        elif kind == 4:
            size = chance.choice((1, 2, 4, 8))
            number = chance.choice(NUMBERS) & ((1 << 8 * size) - 1)
            found[at : at + size] = number.to_bytes(size, chance.choice(("big", "little")))
        elif kind == 5:
            found[at : at + chance.choice((0, span))] = chance.choice(WORDS)
        elif kind == 6:
            other = chance.choice(others)
            begin = chance.randrange(len(other) + 1)
            found[at : at + chance.choice((0, span))] = other[begin : begin + span]
        elif kind == 7:
            del found[at:]
            other = chance.choice(others)
            found += other[chance.randrange(len(other) + 1) :]
        elif at < len(found):
            found[at] = (found[at] + chance.choice((-1, 1))) % 256
    return bytes(found[:LONGEST])


class Storm:
    """Damaged inputs without end, the same for the same seed."""

    def __init__(self, kept: Sequence[bytes], mend: Callable[[bytes], bytes], seed: int) -> None:
        self._kept, self._mend, self._chance = list(kept), mend, random.Random(seed)

    def next(self) -> bytes:
        """One more; two of five with their sums made right."""
        data = damaged(self._chance.choice(self._kept), self._kept, self._chance)
        return self._mend(data) if self._chance.random() < 0.4 else data

    def keep(self, data: bytes) -> None:
        """Damage this one, too, from now on."""
        self._kept.append(data)


def run(feed: Callable[[bytes], None], storm: Storm, size: int) -> Outcome:
    """Feed so many bytes; over the last of them memory is counted, a leak as if it had leaked so all the while.

    Raises:
        AssertionError: the parser has raised or broken a promise; names the input's bytes.
    """
    inputs, fed, worst = _feed(feed, storm, round(size * (1.0 - TRACED)))
    gc.collect()
    tracemalloc.start()
    try:
        warm = _feed(feed, storm, round(size * TRACED / 2))
        gc.collect()
        before = tracemalloc.get_traced_memory()[0]
        last = _feed(feed, storm, round(size * TRACED / 2))
        gc.collect()
        growth = round((tracemalloc.get_traced_memory()[0] - before) * size / max(last[1], 1))
    finally:
        tracemalloc.stop()
    return Outcome(inputs + warm[0] + last[0], fed + warm[1] + last[1], worst, growth)


def _feed(feed: Callable[[bytes], None], storm: Storm, size: int) -> tuple[int, int, float]:
    inputs, fed, worst = 0, 0, 0.0
    while fed < size:
        data = storm.next()
        begin = time.thread_time()
        tell(feed, data)
        worst = max(worst, time.thread_time() - begin)
        inputs, fed = inputs + 1, fed + max(len(data), 1)
    return inputs, fed, worst


def tell(feed: Callable[[bytes], None], data: bytes) -> None:
    """Feed one input; whatever is raised is told with the input that did it."""
    try:
        feed(data)
    except Exception as error:
        shown = data if len(data) < 2000 else data[:2000] + b"..."
        raise AssertionError(f"{type(error).__name__}: {error}\ninput of {len(data)} bytes: {shown!r}") from error


def say(text: str) -> None:
    """A line for people."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
