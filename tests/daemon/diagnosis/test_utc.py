"""`lumiloop why` of recordings in which the clock was set, or which end as a kill or a power cut leaves them."""

import json
import time
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import parser
from daemon.diagnosis.recorded_spans import NoMoment, find, spans
from daemon.diagnosis.utc import Part, parts
from daemon.recording import disk_writer
from daemon.recording.disk_writer import CLOCK, SegmentWriter
from daemon.recording.retention import ABOUT
from daemon.recording.state_file import write_state
from daemon.replay.sources import RecordingSource
from daemon.system import console
from hal.errors import DeviceMissing
from hal.replay.recording import SUFFIX, Kind, open_recording, pack_frame, pack_head, segment_name, state_name
from tests.daemon.replay.test_dump import let_write
from tests.daemon.replay.test_recorded_run import Bench, record

AT = 1.7e9
"""UTC when the monotonic clock was 0."""
BEGUN: dict[str, Any] = {"recording": "x", "t_mono": 0.0, "t_utc": AT}


def segment(folder: Path, number: int, *times: float, ahead: float | None = None) -> Path:
    """A segment with records at these times; ``ahead``: how far the clock has been set when it begins."""
    folder.mkdir(exist_ok=True)
    said = {} if ahead is None else {CLOCK: (times[0], AT + ahead + times[0])}
    path = folder / segment_name(number)
    path.write_bytes(
        pack_head({**BEGUN, **said, "segment": number}) + b"".join(pack_frame(Kind.RX, 0, t, b"abc") for t in times)
    )
    return path


@pytest.mark.parametrize("last", [b"", pack_head({**BEGUN, "segment": 2}), pack_head({**BEGUN, "segment": 2})[:-9]])
def test_a_last_segment_without_a_record_or_a_head_hides_nothing(tmp_path: Path, last: bytes) -> None:
    """Killed just after it was begun; the power went before its head was on the disk."""
    segment(tmp_path / "rec", 0, 1.0, 60.0)
    segment(tmp_path / "rec", 1, 61.0, 120.0)
    (tmp_path / "rec" / segment_name(2)).write_bytes(last)
    (span,) = spans(tmp_path / "rec")
    assert (span.begin, span.end) == (AT, AT + 120.0)


def test_of_a_recording_without_any_record_there_is_no_moment(tmp_path: Path) -> None:
    (tmp_path / segment_name(0)).write_bytes(pack_head({**BEGUN, "segment": 0}))
    (span,) = spans(tmp_path)
    assert span.begin == span.end


def test_a_head_is_on_the_disk_before_its_name_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    monkeypatch.setattr(disk_writer.os, "fdatasync", lambda _: done.append("head"))
    monkeypatch.setattr(disk_writer, "sync_folder", lambda _: done.append("name"))
    SegmentWriter(tmp_path, "run", {"recording": "x"}).close()
    assert done[:2] == ["head", "name"]


def test_after_a_clock_was_set_times_are_those_of_the_new_one(tmp_path: Path) -> None:
    """By 3 s, and seen 10 s after the start: both clocks are told, each where it is true."""
    segment(tmp_path, 0, 0.0, 9.9, ahead=0.0)
    segment(tmp_path, 1, 10.0, 59.9, ahead=3.0)
    segment(tmp_path, 2, 60.0, 120.0, ahead=3.01)
    first, second = spans(tmp_path)
    assert (first.begin, first.end, first.gone) == (AT, AT + 10.0, 3.0)
    assert (second.begin, second.end, second.came) == (AT + 13.0, AT + 123.0, 3.0)
    for words, mono in ((f"{AT + 5.0}", 5.0), (f"{AT + 103.0}", 100.0), ("5.0", 5.0), ("100.0", 100.0), ("9", 9.0)):
        span, utc, _ = find([first, second], words, tmp_path)
        assert utc - span.utc_at_zero == pytest.approx(mono, abs=1e-6)
    with pytest.raises(NoMoment, match=r"after a clock step of \+3\.000 s"):
        find([first, second], f"{AT + 11.5:.1f}", tmp_path)
    assert "the clock was set by +3.000 s before " in first.remarks
    assert first.remarks.endswith("all times here are those before the step")
    assert second.remarks.endswith("all times here are those after the step")


def test_of_a_time_that_came_twice_the_later_is_taken(tmp_path: Path) -> None:
    segment(tmp_path, 0, 0.0, 1799.0, ahead=0.0)
    segment(tmp_path, 1, 1800.0, 3600.0, ahead=-900.0)
    recorded = spans(tmp_path)
    span, utc, _ = find(recorded, f"{AT + 1500.0}", tmp_path)
    assert span is recorded[1]
    assert utc - span.utc_at_zero == 2400.0
    assert find(recorded, "1500", tmp_path)[0] is recorded[0]


def test_a_second_in_which_the_clock_was_set_is_told_from_its_begin(tmp_path: Path) -> None:
    segment(tmp_path, 0, 0.0, 9.0, ahead=0.0)
    segment(tmp_path, 1, 9.5, 20.0, ahead=0.25)
    recorded = spans(tmp_path)
    assert find(recorded, "9", tmp_path) == (recorded[0], AT + 9.0, 1.0)


def dump(folder: Path, about: object) -> None:
    (folder / ABOUT).write_text(json.dumps(about))


def test_a_dump_of_older_software_is_told_by_the_clock_at_its_end(tmp_path: Path) -> None:
    segment(tmp_path, 0, 0.0, 100.0)
    dump(tmp_path, {"t_mono": 99.0, "t_utc": AT + 102.0})
    (span,) = spans(tmp_path)
    assert (span.begin, span.end, span.came) == (AT + 3.0, AT + 103.0, 3.0)
    dump(tmp_path, {"t_mono": 99.0, "t_utc": AT + 99.01})
    (span,) = spans(tmp_path)
    assert (span.came, span.remarks.count("the clock was set")) == (0.0, 0)


@pytest.mark.parametrize("about", [[], {}, {"t_mono": "soon", "t_utc": 1.0}, {"t_mono": 1.0, "t_utc": 1e300}])
def test_a_dump_that_says_no_time_says_nothing(tmp_path: Path, about: object) -> None:
    segment(tmp_path, 0, 0.0, 100.0)
    dump(tmp_path, about)
    assert spans(tmp_path)[0].begin == AT


@pytest.mark.parametrize("said", [None, 5.0, [1.0], [1.0, "soon"], [1.0, 1e300]])
def test_a_head_that_says_no_time_says_nothing(tmp_path: Path, said: object) -> None:
    path = tmp_path / segment_name(0)
    path.write_bytes(pack_head({**BEGUN, CLOCK: said, "segment": 0}))
    assert parts(tmp_path, [path], (0.0, AT), 0.0) == [Part(0.0, AT)]


def test_what_begins_after_a_clock_was_set_is_told_by_the_new_one_alone(tmp_path: Path) -> None:
    path = segment(tmp_path, 7, 600.0, ahead=86400.0)
    assert parts(tmp_path, [path], (0.0, AT), 600.0) == [Part(600.0, AT + 86400.0)]


def test_the_state_that_a_recording_begins_with_says_its_clock_before_the_head_does(tmp_path: Path) -> None:
    """The head is written up to a tenth of a second later: no step is seen between them."""
    path = segment(tmp_path, 7, 600.08, ahead=3.0)
    write_state(tmp_path / state_name(7), {CLOCK: (600.0, AT + 603.0)}, b"", [])
    assert parts(tmp_path, [path], (0.0, AT), 600.0) == [Part(600.0, AT + 3.0)]


async def stepped(bench: Bench) -> None:
    """The clock is set while the robot drives."""
    await bench.drive(4.0)
    bench.clock._utc_at_zero += 3.0
    await bench.drive(0.1)
    end = time.monotonic() + 10.0
    while bench.recorder.disk._segment == 0 and time.monotonic() < end:
        let_write(0.01)
    await bench.drive(4.0)


def test_a_clock_that_is_set_begins_a_segment_and_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.002)
    record(tmp_path / "rec", stepped)
    (run,) = (tmp_path / "rec").iterdir()
    assert [path.name for path in sorted(run.glob(f"*{SUFFIX}"))] == [segment_name(0), segment_name(1)]
    first, second = spans(run)
    assert second.utc_at_zero - first.utc_at_zero == pytest.approx(3.0, abs=1e-6)
    assert second.before_s == pytest.approx(4.0, abs=1.0)
    assert parser.main(["replay", str(run), "--out", str(tmp_path / "out")]) == console.OK
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["recorded_run"]["differ"] == 0
    capsys.readouterr()
    assert parser.main(["why", f"{second.end - 1.0:.3f}", str(run)]) == console.OK
    head, remark, *_ = capsys.readouterr().out.splitlines()
    assert "the clock was set by +3.000 s before " in remark
    at = time.strftime("%H:%M:%S", time.localtime(second.end - 1.0))
    assert f" {at}." in head.partition(", cycle of ")[0]


def test_a_clock_that_is_set_all_the_time_does_not_make_a_segment_of_every_write(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.001)

    class Jumping:
        utc_s = AT

        def now(self) -> float:
            return 1.0

        def utc(self) -> float:
            self.utc_s += 1.0
            return self.utc_s

    out = SegmentWriter(tmp_path, "run", {"recording": "x"}, clock=Jumping())
    for number in range(20):
        out.put(Kind.RX, 0, float(number), b"abc")
        let_write(0.005)
    out.close()
    assert [path.name for path in sorted((tmp_path / "run").iterdir())] == [segment_name(0), segment_name(1)]
    assert open_recording(tmp_path / "run").header[CLOCK][0] == 1.0


def test_a_segment_that_the_keeper_takes_away_meanwhile_is_an_error_that_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Between its name and its size; another recording is told of all the same."""
    from daemon.replay import sources

    beginning = sources.beginning
    taken = segment(tmp_path / "ring", 0, 0.0, 100.0)
    segment(tmp_path / "ring", 1, 101.0, 200.0)
    segment(tmp_path / "whole", 0, 0.0, 50.0)

    def pruned(*args: Any) -> Any:
        found = beginning(*args)
        taken.unlink(missing_ok=True)
        return found

    monkeypatch.setattr(sources, "beginning", pruned)
    with pytest.raises(DeviceMissing, match=segment_name(0)):
        RecordingSource(tmp_path / "ring")
    segment(tmp_path / "ring", 0, 0.0, 100.0)
    (span,) = spans(tmp_path)
    assert span.path.name == "whole"
    assert "ignored" in capsys.readouterr().err
