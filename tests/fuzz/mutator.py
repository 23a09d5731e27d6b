"""Damaged bytes for parsers: one mutator, which hypothesis or a plain generator drives.

Damage is done to well-formed inputs and to the corpus: inputs that a search by coverage found (`tests/fuzz/corpus`).
"""

import gc
import random
import time
import tracemalloc
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from hypothesis import strategies as st

CORPUS: Final = Path(__file__).parent / "corpus"
LONGEST: Final = 1 << 16
TRACED: Final = 0.05
"""Share of the bytes over which each allocation is counted, twice; that takes several times as long."""

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


def corpus(name: str) -> list[bytes]:
    """Inputs that are kept for a target."""
    return [file.read_bytes() for file in sorted((CORPUS / name).glob("*"))]


def damaged(data: bytes, others: Sequence[bytes], chance: random.Random) -> bytes:
    """Damage as it happens: flips, losses, repetitions, foreign parts, extreme numbers and words, cuts."""
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


@st.composite
def inputs(draw: st.DrawFn, kept: Sequence[bytes], mend: Callable[[bytes], bytes]) -> bytes:
    """Damaged inputs; hypothesis shrinks the damage. Half of them get correct check sums again."""
    data = damaged(draw(st.sampled_from(kept)), kept, draw(st.randoms(use_true_random=False)))
    return mend(data) if draw(st.booleans()) else data


def steady(
    feed: Callable[[bytes], None], kept: Sequence[bytes], mend: Callable[[bytes], bytes], size: int
) -> tuple[float, int]:
    """Feed ``size`` damaged bytes, the same in every run.

    Returns:
        Longest processor time of one input (s), and growth of memory (bytes), scaled to the whole size.
    """
    chance = random.Random(0)

    def part(until: float) -> float:
        fed, worst = 0, 0.0
        while fed < until:
            data = damaged(chance.choice(kept), kept, chance)
            data = mend(data) if chance.random() < 0.4 else data
            begin = time.thread_time()
            feed(data)
            worst, fed = max(worst, time.thread_time() - begin), fed + max(len(data), 1)
        gc.collect()
        return worst

    worst = part(size * (1.0 - 2.0 * TRACED))
    tracemalloc.start()
    try:
        part(size * TRACED)
        before = tracemalloc.get_traced_memory()[0]
        part(size * TRACED)
        return worst, round((tracemalloc.get_traced_memory()[0] - before) / TRACED)
    finally:
        tracemalloc.stop()
