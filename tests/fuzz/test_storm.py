"""Every parser under damaged bytes: the kept corpus always, a tenth of the full size in ``make test-system``, then all.

Each storm runs in a process of its own, so that nothing else is charged with its memory. See ``python -m tests.fuzz``.
"""

from __future__ import annotations

import importlib
import random
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.fuzz import storm
from tests.fuzz.targets import NAMES

ROOT = Path(__file__).parents[2]
TENTH, WHOLE = 0.1, 1.0


@pytest.mark.parametrize("name", NAMES)
def test_what_was_kept_breaks_nothing(name: str) -> None:
    target = importlib.import_module(f"tests.fuzz.targets.{name}")
    feed, kept = target.feeder(), storm.corpus(name)
    assert kept, f"nothing in tests/fuzz/corpus/{name}: python -m tests.fuzz {name} --grow 60"
    for data in [*target.seeds(), *kept]:
        feed(data)
        feed(target.mend(data))


@pytest.mark.parametrize("name", NAMES)
def test_mending_leaves_what_is_sound_as_it_is(name: str) -> None:
    """Else nothing that is fed with its sums made right would reach what lies behind them."""
    target = importlib.import_module(f"tests.fuzz.targets.{name}")
    seeds = target.seeds()
    assert sum(target.mend(data) == data for data in seeds) >= len(seeds) // 2


@pytest.mark.parametrize("name", NAMES)
@given(data=st.binary(max_size=600))
@settings(max_examples=25)
def test_any_bytes(name: str, data: bytes) -> None:
    target = importlib.import_module(f"tests.fuzz.targets.{name}")
    feed = target.feeder()
    feed(data)
    feed(target.mend(data))


def test_a_storm_finds_what_is_wrong_and_tells_the_input() -> None:
    def fragile(data: bytes) -> None:
        if b"\x00\x07" in data:
            raise IndexError("seven")

    kept = [b"\x00\x06abc", b"hello"]
    with pytest.raises(AssertionError, match=r"IndexError: seven\ninput of \d+ bytes: b'"):
        storm.run(fragile, storm.Storm(kept, bytes, 1), 1_000_000)


def test_a_storm_counts_what_is_kept_and_how_long_it_takes() -> None:
    kept: list[bytes] = []

    def hoarding(data: bytes) -> None:
        kept.append(bytes(len(data) + 1000))

    outcome = storm.run(hoarding, storm.Storm([b"x" * 1000], bytes, 1), 60_000)
    assert 0.5 * sum(map(len, kept)) < outcome.growth < 2.0 * sum(map(len, kept))  # not of the last part alone
    assert outcome.fed >= 60_000
    assert storm.run(lambda data: None, storm.Storm([b"x" * 1000], bytes, 1), 60_000).growth < 20_000


def test_a_storm_is_the_same_for_the_same_seed() -> None:
    kept = [random.Random(3).randbytes(200), b"abc"]
    one, same, other = (storm.Storm(kept, bytes, seed) for seed in (1, 1, 2))
    assert [one.next() for _ in range(50)] == [same.next() for _ in range(50)]
    assert [one.next() for _ in range(50)] != [other.next() for _ in range(50)]


def storm_of(name: str, share: float) -> None:
    command = [sys.executable, "-m", "tests.fuzz", name, "--share", str(share)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    sys.stdout.write(done.stdout)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.system
@pytest.mark.parametrize("name", NAMES)
def test_a_tenth(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        storm_of(name, TENTH)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", NAMES)
def test_the_whole(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled():
        storm_of(name, WHOLE)
