"""Damaged scans: nothing crashes, and what is accepted is what the format itself cannot tell from a good frame.

The judge is a second, slow reading of the format, written here from the specification: where the driver accepts a
damaged frame with other values, that frame must be a well-formed SCIP frame, every sum included. How rare those are is
asserted too, and that no single damaged character can be among them.
"""

from collections import Counter
from collections.abc import Callable
from random import Random

import numpy as np
import pytest

from hal.hokuyo.payload import ScanRequest, parse_scan
from hal.hokuyo.scip import BadFrame, FrameSplitter, parse_reply
from tests.fuzz.mutator import damaged
from tests.hal.hokuyo import encoder

Mutation = Callable[[bytearray, Random], None]
Values = tuple[int, list[int]]


def flip_bit(frame: bytearray, r: Random) -> None:
    frame[r.randrange(len(frame))] ^= 1 << r.randrange(8)


def other_byte(frame: bytearray, r: Random) -> None:
    frame[r.randrange(len(frame))] = r.randrange(256)


def other_character(frame: bytearray, r: Random) -> None:
    frame[r.randrange(len(frame))] = r.randrange(0x30, 0x70)


def lose_byte(frame: bytearray, r: Random) -> None:
    del frame[r.randrange(len(frame))]


def add_byte(frame: bytearray, r: Random) -> None:
    frame.insert(r.randrange(len(frame)), r.randrange(256))


SINGLE: list[Mutation] = [flip_bit, other_byte, other_character, lose_byte, add_byte]


def swap(frame: bytearray, r: Random) -> None:
    i, j = r.randrange(len(frame)), r.randrange(len(frame))
    frame[i], frame[j] = frame[j], frame[i]


def opposite(frame: bytearray, r: Random) -> None:
    """Two errors that cancel in a sum."""
    i, d = r.randrange(len(frame) - 1), r.randrange(1, 16)
    frame[i] = (frame[i] + d) % 256
    frame[i + 1] = (frame[i + 1] - d) % 256


def swap_lines(frame: bytearray, r: Random) -> None:
    lines = bytes(frame).split(b"\n")
    i, j = r.randrange(len(lines) - 2), r.randrange(len(lines) - 2)
    lines[i], lines[j] = lines[j], lines[i]
    frame[:] = b"\n".join(lines)


def any_damage(frame: bytearray, r: Random) -> None:
    """Losses, repetitions, foreign text, bursts, cuts: several at a time."""
    frame[:] = damaged(bytes(frame), ALIEN, r)


ALIEN = [b"AT\n0Ee\n\n", b"II\n00P\nLASR:ON;9\n\n", b"\n", b"\n\n", b"QT\n00P\n\n", b"0" * 70]
MUTATIONS = [*SINGLE, swap, opposite, swap_lines, any_damage]


def slow_reading(frame: bytes, request: ScanRequest) -> Values | None:
    """Stamp and values of a well-formed data frame of ``request``; None for anything else."""
    lines = frame.split(b"\n")
    if lines[0] != request.echo or len(lines) < 4 or lines[1] != b"99b" or len(lines[2]) != 5:
        return None
    parts = [line[:-1].decode("latin-1") for line in lines[2:]]
    if any(encoder.sum_char(part) != chr(line[-1]) for part, line in zip(parts, lines[2:], strict=True) if line):
        return None
    if any(len(part) != 64 for part in parts[1:-1]) or not 0 < len(parts[-1]) <= 64:
        return None
    text = "".join(parts[1:])
    if any(not 0x30 <= ord(char) <= 0x6F for char in parts[0] + text):
        return None
    size = 3 * (2 if request.name == "ME" else 1)
    if len(text) // size not in request.beams or len(text) % size:
        return None

    def value(chars: str) -> int:
        total = 0
        for char in chars:
            total = total * 64 + ord(char) - 48
        return total

    return value(parts[0]), [value(text[i : i + 3]) for i in range(0, len(text), 3)]


def driver_reading(frame: bytes, request: ScanRequest) -> Values | None:
    try:
        scan = parse_scan(request, parse_reply(frame))
    except BadFrame:
        return None
    columns = [scan.distance] if scan.intensity is None else [scan.distance, scan.intensity]
    return scan.stamp, np.stack(columns, axis=1).ravel().tolist()


def storm(request: ScanRequest, rounds: int, seed: int) -> tuple[Counter[str], Counter[str]]:
    """Mutate ``rounds`` frames; returns acceptances with other values, and attempts, by mutation."""
    r = Random(seed)
    rng = np.random.default_rng(seed)
    columns = 2 if request.name == "ME" else 1
    accepted: Counter[str] = Counter()
    tried: Counter[str] = Counter()
    good = b""
    for k in range(rounds):
        if k % 500 == 0:
            steps = rng.integers(0, 30000, (request.beams[1], columns)).tolist()
            stamp = int(rng.integers(0, 2**24))
            good = encoder.scan(request.echo.decode(), stamp, encoder.payload([[tuple(s)] for s in steps]))
            truth = (stamp, [v for s in steps for v in s])
            assert driver_reading(good[:-2], request) == truth
        mutation = r.choice(MUTATIONS)
        frame = bytearray(good)
        mutation(frame, r)
        tried[mutation.__name__] += 1
        for piece in FrameSplitter().feed(bytes(frame) + b"\n\n"):
            seen = driver_reading(piece, request)
            if seen is not None and seen != truth:
                assert slow_reading(piece, request) == seen
                accepted[mutation.__name__] += 1
    return accepted, tried


def judge(accepted: Counter[str], tried: Counter[str]) -> None:
    for mutation in SINGLE:
        assert tried[mutation.__name__] > 100
        assert accepted[mutation.__name__] == 0, "a single damaged character got through"
    for blind in ("swap", "opposite", "swap_lines"):  # what a sum cannot see: places exchanged
        accepted.pop(blind, None)
    total = sum(tried.values())
    assert sum(accepted.values()) < 5e-4 * total


@pytest.mark.parametrize(
    ("request_", "rounds"),
    [(ScanRequest("MD", 44, 107), 80_000), (ScanRequest("ME", 0, 60), 20_000)],
    ids=["MD", "ME"],
)
def test_hundred_thousand_damaged_frames(request_: ScanRequest, rounds: int) -> None:
    judge(*storm(request_, rounds, seed=1))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_million_damaged_frames_of_full_size(seed: int) -> None:
    judge(*storm(ScanRequest("ME" if seed % 2 else "MD", 0, 1080), 250_000, seed=10 + seed))


class TestMultiEcho:
    request = ScanRequest("NE", 0, 29)

    def test_damaged_multi_echo_frames(self) -> None:
        """Single errors change no value and no number of echoes, unless the echo's own mark has moved unseen."""
        r = Random(3)
        steps = [[(r.randrange(40000), r.randrange(9000)) for _ in range(r.choice([1, 1, 2, 3]))] for _ in range(30)]
        good = encoder.scan(self.request.echo.decode(), 77, encoder.payload(steps))
        truth = parse_scan(self.request, parse_reply(good[:-2]))
        through = 0
        for _ in range(20_000):
            frame = bytearray(good)
            r.choice(SINGLE)(frame, r)
            for piece in FrameSplitter().feed(bytes(frame) + b"\n\n"):
                try:
                    scan = parse_scan(self.request, parse_reply(piece))
                except BadFrame:
                    continue
                assert truth.echoes is not None
                same = (scan.distance == truth.distance).all() and (scan.echoes == truth.echoes).all()
                through += not same
        assert through == 0
