"""Which moment `lumiloop why` takes for what somebody writes, and in which recording."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path

import pytest

from daemon.diagnosis.recorded_spans import NoMoment, Span, find, meant, whole_second, width
from tests.daemon.diagnosis.zones import BERLIN, local_time

AT = datetime(2023, 11, 14, 22, 13, 20, tzinfo=UTC).timestamp()
SPAN = Span(Path("rec"), AT, AT + 3600.0, AT - 100.0)


@pytest.mark.parametrize(
    ("words", "after"),
    [
        ("22:13:25Z", 5.0),
        ("22:14Z", 40.0),
        ("22:13:25.5Z", 5.5),
        ("23:13:25+01:00", 5.0),
        ("16:43:25.5-0530", 5.5),
        ("22:13:25,5Z", 5.5),
        ("2023-11-14T22:13:25,5Z", 5.5),
        ("5,25", 5.25),
        ("2023-11-14T22:13:25Z", 5.0),
        ("2023-11-14 23:13:25+01:00", 5.0),
        ("5", 5.0),
        ("5.25", 5.25),
        (f"{AT + 5.0}", 5.0),
    ],
)
def test_times_are_understood(words: str, after: float) -> None:
    span, utc, _ = find([SPAN], words, Path())
    assert span is SPAN
    assert utc - AT == pytest.approx(after, abs=1e-6)


@pytest.mark.parametrize("words", ["22:13:25.5Z", "22:13:25,5Z", "2023-11-14T22:13:25,5Z", "5,0", "5.0"])
def test_a_fraction_however_it_is_written_is_no_whole_second(words: str) -> None:
    assert not whole_second(words)


def test_a_time_of_the_day_may_be_of_the_next_day() -> None:
    night = Span(Path("rec"), AT, AT + 7200.0, 0.0)
    assert find([night], "00:05:00Z", Path())[1] - AT == 6700.0


def test_without_a_zone_it_is_local_time() -> None:
    local = datetime.fromtimestamp(AT + 5.0, UTC).astimezone()
    assert find([SPAN], f"{local:%H:%M:%S}", Path())[1] - AT == 5.0
    assert find([SPAN], f"{local:%Y-%m-%dT%H:%M:%S}", Path())[1] - AT == 5.0


@pytest.mark.parametrize(
    "words",
    [
        "yesterday",
        "25:00:00",
        "21:61",
        "",
        "nan",
        "-5",
        "2023-13-01T00:00:00Z",
        "21:14:60",
        "0001-01-01T00:00",
        "5.",
        "22:13:25.Z",
    ],
)
def test_what_is_no_time_is_refused_with_the_ways_to_write_one(words: str) -> None:
    with pytest.raises(NoMoment, match="give 21:14:07"):
        meant(words, SPAN)


def test_a_time_beyond_all_calendars_is_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with local_time(monkeypatch, "EST5"), pytest.raises(NoMoment, match="give 21:14:07"):
        meant("9999-12-31T23:59", SPAN)


def test_of_two_recordings_the_one_with_more_before_it_is_taken() -> None:
    ring = Span(Path("ring"), AT + 4.0, AT + 3600.0, 0.0)
    assert find([ring, SPAN], "22:13:30Z", Path())[0] is SPAN


def test_a_time_that_nobody_has_recorded_is_told_with_those_that_were() -> None:
    with pytest.raises(NoMoment, match=r"covers this time; available:(.|\n)* rec"):
        find([SPAN], "21:00:00Z", Path())


def test_a_second_of_which_a_part_is_recorded_is_found_and_an_instant_is_not() -> None:
    late = Span(Path("late"), AT + 5.4, AT + 60.0, 0.0)
    span, utc, wide = find([late], "22:13:25Z", Path())
    assert (span, utc) == (late, AT + 5.4)
    assert wide == pytest.approx(0.6, abs=1e-6), "what is left of it"
    assert find([SPAN], "23:13:20Z", Path())[1] - AT == 3600.0
    with pytest.raises(NoMoment, match="covers this time"):
        find([late], "22:13:25.0Z", Path())
    next_one = Span(Path("next"), AT + 6.0, AT + 60.0, 0.0)
    with pytest.raises(NoMoment, match="covers this time"):
        find([next_one], "22:13:25Z", Path())


def test_the_last_instant_of_a_recording_is_in_it_however_the_sum_is_rounded() -> None:
    """Ends are to the microsecond; a number of seconds is added to the beginning."""
    for k in range(1, 200):
        span = Span(Path("rec"), AT + 0.4, round(AT + 0.4 + 1e-3 * k, 6), 0.0)
        _, utc, wide = find([span], f"{1e-3 * k:.3f}", Path())
        assert (utc, wide) == (span.end, 1e-3)


@pytest.mark.parametrize(
    ("words", "wide"),
    [
        ("22:13:25Z", 1.0),
        ("22:13:25.5Z", 0.1),
        ("22:13:25,123Z", 1e-3),
        ("5.0", 0.1),
        ("5", 1.0),
        ("22:14Z", 1.0),
        ("5.1234567", 1e-6),
    ],
)
def test_how_wide_that_is(words: str, wide: float) -> None:
    assert width(words) == pytest.approx(wide, abs=1e-12)
    assert find([SPAN], words, Path())[2] == pytest.approx(wide, abs=1e-9)


@pytest.fixture
def berlin(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with local_time(monkeypatch, BERLIN):
        yield


def instant(text: str) -> float:
    return datetime.fromisoformat(text).timestamp()


@pytest.mark.usefixtures("berlin")
@pytest.mark.parametrize(
    ("words", "begin", "meant_at"),
    [
        ("08:00:00", "2026-10-25T00:30+02:00", ["2026-10-25T08:00+01:00", "2026-10-26T08:00+01:00"]),
        ("01:00:00", "2026-10-25T00:30+02:00", ["2026-10-25T01:00+02:00", "2026-10-26T01:00+01:00"]),
        ("02:30:00", "2026-10-25T00:30+02:00", [
            "2026-10-25T02:30+02:00", "2026-10-25T02:30+01:00", "2026-10-26T02:30+01:00",
        ]),
        ("2026-10-25T02:30", "2026-10-25T00:30+02:00", ["2026-10-25T02:30+02:00", "2026-10-25T02:30+01:00"]),
        ("02:30:00+01:00", "2026-10-25T00:30+02:00", ["2026-10-25T02:30+01:00", "2026-10-26T02:30+01:00"]),
    ],
)  # fmt: skip
def test_a_time_of_the_day_is_that_of_its_own_day(words: str, begin: str, meant_at: list[str]) -> None:
    span = Span(Path("rec"), instant(begin), instant("2026-10-26T09:00+01:00"), 0.0)
    found = [utc for utc in meant(words, span) if span.begin <= utc <= span.end]
    assert found == list(map(instant, meant_at))
    assert find([span], words, Path())[1] == found[0], "the first"


@pytest.mark.usefixtures("berlin")
def test_a_time_that_the_place_never_had_is_not_recorded() -> None:
    span = Span(Path("rec"), instant("2026-03-29T00:30+01:00"), instant("2026-03-29T09:00+02:00"), 0.0)
    assert meant("02:30:00", span) == []
    with pytest.raises(NoMoment, match=r"available:\n  2026-03-29 00:30:00.000\+0100 to 2026-03-29 09:00:00.000\+0200"):
        find([span], "02:30:00", Path())
