"""Which cycle `lumiloop why` takes for a time, and how it says which time that is."""

from collections.abc import Iterator
from dataclasses import replace
from datetime import UTC, datetime
from types import SimpleNamespace
from typing import Any

import pytest

from daemon.diagnosis.moment import Moment, chosen, clock, first_change, moment_of, of_day
from daemon.diagnosis.moment_report import report
from daemon.health.reasons import Reason
from daemon.snapshot import Snapshot, State
from tests.daemon.diagnosis.zones import BERLIN, local_time

AT = datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC).timestamp()
NOTHING = Snapshot(1, 1.0, 1.0, 0.0, State.DEGRADED, Reason.NONE)
WELL = Moment(0.0, State.DEGRADED, NOTHING, None, None, True, None, 0, ())


@pytest.fixture(autouse=True)
def utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Times are printed as local ones."""
    with local_time(monkeypatch, "UTC0"):
        yield


def cycles(*after: float, fault: float) -> list[Moment]:
    """Of which nothing changes in those ``after`` AT, s; then one that publishes a fault."""
    well = [replace(WELL, utc=round(AT + s, 6)) for s in after]
    return [*well, replace(WELL, utc=round(AT + fault, 6), faults=(101,))]


def head(told: list[Moment], after: float, wide: float = 1.0) -> str:
    return report(told, round(AT + after, 6), "here", wide, second=True).splitlines()[0]


@pytest.mark.parametrize(
    ("after", "fault", "says"),
    [
        ((5.5, 6.01), 6.12, "no change of state, reason or faults in it; a change 0.12 s after it"),
        ((5.5, 6.01), 6.2, "no change of state, reason or faults in it, cycle of"),
        ((5.5,), 6.95, "no change of state, reason or faults in it; a change 0.95 s after it"),
        ((5.5,), 7.05, "no change of state, reason or faults in it, cycle of"),
        ((5.5,), 6.0, "no change of state, reason or faults in it; a change 0.00 s after it"),
        ((5.5, 6.0), 6.3, "no change of state, reason or faults in it, cycle of"),
        ((4.5,), 5.0, "first change of state, reason or faults in it"),
    ],
)
def test_what_is_published_after_a_second_counts_for_as_long_as_it_may_be_of_it(
    after: tuple[float, ...], fault: float, says: str
) -> None:
    """0.15 s, or with the first cycle, where that comes within a second."""
    told = cycles(*after, fault=fault)
    assert says in head(told, 5.0)
    found = "no change of state, reason or faults in it, " not in says
    assert first_change(told, AT + 5.0, 1.0) == (len(after) if found else None)
    assert ("fault 101 comes" in report(told, AT + 5.0, "here", 1.0, second=True)) is found


@pytest.mark.parametrize("digits", range(1, 7))
def test_a_cycle_that_begins_when_the_last_digit_turns_is_not_meant(digits: int) -> None:
    """The sum of a time and of how long it lasts may be a quarter of a microsecond beyond."""
    wide = 10.0**-digits
    for k in range(123, 223):
        turn = round(AT + wide * (k + 1), 6)
        told = [replace(WELL, utc=turn - 0.5), replace(WELL, utc=turn)]
        assert chosen(told, round(AT + wide * k, 6), second=False, wide=wide).cycle == 0, of_day(turn)


@pytest.mark.parametrize("begun", [AT + 4.9999998, AT + 5.0000002])
def test_what_is_judged_of_a_boundary_is_what_is_printed_of_it(begun: float) -> None:
    entry: Any = SimpleNamespace(state=int(State.DEGRADED), commands=(), reason=0, faults=(101,))
    record: Any = SimpleNamespace(t_mono=begun - AT, snapshot=NOTHING, result=None, scan=None, limits=None, dropped=())
    cycle: Any = SimpleNamespace(observer=SimpleNamespace(motion_consistency=SimpleNamespace(compared=lambda: None)))
    one = moment_of(AT, entry, record, cycle)
    assert of_day(one.utc).endswith(":25.000")
    told = [replace(WELL, utc=AT + 4.5), one]
    assert "first change of state, reason or faults in it" in head(told, 5.0)
    assert "change 0.00 s after it" in head(told, 4.0)


def test_of_a_second_of_which_a_part_is_recorded_that_part_is_told() -> None:
    """Of 22:13:25, where the recording begins at 25.4: it ends at 26, not at 26.4."""
    assert "22:13:25.400+0000, the rest of that second: no change of state, reason or faults in it, cycle" in head(
        cycles(5.5, 6.1, fault=6.3), 5.4, 0.6
    )
    assert "no change of state, reason or faults in it; a change 0.05 s after it" in head(
        cycles(5.5, fault=6.05), 5.4, 0.6
    )
    assert "first change of state, reason or faults in it" in head(cycles(5.5, fault=5.999), 5.4, 0.6)
    assert "change 0.00 s after it" in head(cycles(5.5, fault=6.0), 5.4, 0.6)
    told = cycles(5.3, 6.2, fault=9.0)
    assert chosen(told, AT + 5.4, second=True, wide=0.6).cycle == 0, "none ran in that part"


def test_a_second_that_does_not_begin_with_one_of_the_clock_is_named_with_its_beginning() -> None:
    """That is a number of seconds since a recording began."""
    said = head(cycles(5.5, fault=6.3), 5.4)
    assert (
        "22:13:25.400+0000, the second after it: first change of state, reason or faults in it, cycle of 22:13:26.300"
        in said
    )
    assert "22:13:25+0000, the whole second: " in head(cycles(5.5, fault=5.7), 5.0)
    assert "22:13:25.400+0000, without a cycle; the last one before ran 5 s earlier" in head(
        cycles(0.1, fault=0.2), 5.4
    )


def test_before_its_first_cycle_no_time_is_less_than_none() -> None:
    assert "what changed in the 0 s before" in report([replace(WELL, utc=AT)], AT - 50.0, "here", 0.1)


@pytest.mark.parametrize(
    ("utc", "said"), [(1792886400.25, "2026-10-25 02:00:00.250+0200"), (1792890000.25, "2026-10-25 02:00:00.250+0100")]
)
def test_a_time_is_told_with_the_offset_of_its_own_day_and_hour(
    utc: float, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with local_time(monkeypatch, BERLIN):
        assert clock(utc) == said
