"""Every parser under damaged bytes: corpus and a sample always; memory and time by the megabyte in the longer suites.

``make fuzz`` runs this file with a tenth of the full size, ``make fuzz ARGS="-m slow"`` with all of it.
"""

import importlib
import sys
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.fuzz.mutator import corpus, inputs, steady
from tests.fuzz.targets import NAMES

STALL_S, GROWTH = 1.0, 1 << 20
TENTH = pytest.param(0.1, 1000, marks=pytest.mark.system, id="tenth")
WHOLE = pytest.param(1.0, 20_000, marks=[pytest.mark.slow, pytest.mark.timeout(3600)], id="whole")

named = pytest.mark.parametrize("name", NAMES)


def target(name: str) -> Any:
    return importlib.import_module(f"tests.fuzz.targets.{name}")


@named
def test_what_was_kept_breaks_nothing(name: str) -> None:
    feed, kept = target(name).feeder(), corpus(name)
    assert kept, f"nothing in tests/fuzz/corpus/{name}"
    for data in [*target(name).seeds(), *kept]:
        feed(data)
        feed(target(name).mend(data))


@named
def test_mending_leaves_what_is_sound_as_it_is(name: str) -> None:
    """Else nothing that is fed with its sums made right would reach what lies behind them."""
    seeds = target(name).seeds()
    assert sum(target(name).mend(data) == data for data in seeds) >= len(seeds) // 2


@named
@given(data=st.binary(max_size=600))
@settings(max_examples=25)
def test_any_bytes(name: str, data: bytes) -> None:
    feed = target(name).feeder()
    feed(data)
    feed(target(name).mend(data))


def damage(name: str, examples: int) -> None:
    """Feed damaged inputs to one parser; a failure is shrunk to the least damage that causes it."""
    feed, mend = target(name).feeder(), target(name).mend
    kept = [*target(name).seeds(), *corpus(name)]
    slow = [HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.large_base_example]
    given(inputs(kept, mend))(settings(max_examples=examples, suppress_health_check=slow)(feed))()


@named
def test_damaged_bytes(name: str) -> None:
    damage(name, 25)


@pytest.mark.parametrize(("share", "examples"), [TENTH, WHOLE])
@named
def test_neither_memory_nor_time(name: str, share: float, examples: int, capsys: pytest.CaptureFixture[str]) -> None:
    """No input takes a second, and the megabytes leave no memory behind; then examples that hypothesis shrinks."""
    kept, size = [*target(name).seeds(), *corpus(name)], round(share * target(name).MEGABYTES * 1e6)
    worst, growth = steady(target(name).feeder(), kept, target(name).mend, size)
    with capsys.disabled():
        line = f"{name}: {size / 1e6:.2f} MB, longest {1e3 * worst:.0f} ms, {growth / 1e3:+.1f} kB kept of all"
        sys.stdout.write(f"\n{line}\n")
    assert worst < STALL_S
    assert growth < GROWTH
    damage(name, examples)


def test_growth_and_time_are_seen() -> None:
    kept: list[bytes] = []
    _, growth = steady(lambda data: kept.append(bytes(len(data) + 1000)), [b"x" * 1000], bytes, 60_000)
    assert 0.5 * sum(map(len, kept)) < growth < 2.0 * sum(map(len, kept))
    worst, growth = steady(lambda data: sum(range(200_000)) and None, [b"x" * 1000], bytes, 20_000)
    assert worst > 5e-4
    assert growth < 20_000


def test_damage_is_found() -> None:
    def fragile(data: bytes) -> None:
        if b"\x00\x07" in data:
            raise IndexError("seven")

    with pytest.raises(IndexError, match="seven"):
        given(inputs([b"\x00\x06abc", b"hello"], bytes))(settings(max_examples=5000, database=None)(fragile))()
