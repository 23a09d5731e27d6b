"""Dumps of the flight recorder, replayed: they begin in the middle of a run and give the same poses to the last bit."""

import json
import struct
import tempfile
import time
import zlib
from pathlib import Path
from typing import Any

import pytest

from daemon.cli import parser
from daemon.config.schema import Config
from daemon.health.faults import Fault
from daemon.recording import checkpoint, disk_writer, flight_recorder, state_file
from daemon.recording.disk_writer import CLOCK, SegmentWriter
from daemon.recording.replay_start import CYCLE_PARTS
from daemon.recording.retention import ABOUT, DUMP, Flight
from daemon.recording.state_file import read_header
from daemon.replay.log_replay import replay
from daemon.replay.sources import open_log
from daemon.system import console
from hal.clock import run_virtual
from hal.errors import DataInvalid
from hal.replay.recording import Kind, frames_in, open_recording
from hal.replay.report import LogReport
from tests.daemon.replay.test_recorded_lights import Recorded
from tests.daemon.replay.test_recorded_lights import record as record_lit
from tests.daemon.replay.test_recorded_run import USB, Bench, record
from tests.daemon.scenarios.test_lights import decoded


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's thread lives in real time, the daemon in virtual time: both are to get somewhere."""
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.002)
    monkeypatch.setattr(flight_recorder, "EVERY_S", 2.0)
    monkeypatch.setattr(flight_recorder, "LEAST_S", 2.0)


def let_write(seconds: float) -> None:
    """Virtual time stands still for the writing threads."""
    time.sleep(seconds)


def replayed(folder: Path, out: Path, *options: str) -> dict[str, dict[str, Any]]:
    assert parser.main(["replay", str(folder), "--out", str(out), *options]) == console.OK
    summary: dict[str, dict[str, Any]] = json.loads((out / "summary.json").read_text())
    return summary


def states(folder: Path) -> list[Path]:
    return sorted(folder.glob("*/*.lumistate"))


async def long(bench: Bench) -> None:
    for _ in range(6):
        await bench.drive(2.0)
        let_write(0.05)


async def longer(bench: Bench) -> None:
    """Long enough for three states, of which each may be as large as what was recorded since the one before."""
    await long(bench)
    await bench.drive(4.0)
    let_write(0.05)


def test_every_state_is_a_beginning(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", longer)
    assert not bench.recorder.failing
    (run,) = (tmp_path / "rec").iterdir()
    found = states(tmp_path / "rec")
    assert len(found) >= 3
    whole = replayed(run, tmp_path / "whole")["recorded_run"]
    assert whole["differ"] == 0
    for number, state in enumerate(found):
        said = read_header(state)
        assert said[CLOCK] == pytest.approx([said["t_state"], 1.7e9 + said["t_state"]], abs=1e-6)
        for old in sorted(run.glob("*.lumirec")):
            if old.stem < state.stem:
                old.unlink()
                old.with_suffix(".lumistate").unlink(missing_ok=True)
        compared = replayed(run, tmp_path / f"out{number}")["recorded_run"]
        assert compared["differ"] == 0, compared
        assert 0 < compared["cycles"] < whole["cycles"]


def broken(*_: object) -> None:
    raise KeyError("a defect")


async def asked(bench: Bench) -> None:
    """Command 7 in the middle of a drive."""
    await long(bench)
    said: list[str] = []
    bench.recorder.box.dump(said.append)
    refused: list[str] = []
    bench.recorder.box.dump(refused.append)
    assert refused == [flight_recorder.UNDER_WAY]
    for _ in range(100):
        await bench.drive(0.1)
        let_write(0.01)
        if said:
            break
    assert said == [""]
    bench.recorder.box.dump(refused.append)
    assert refused[1].startswith("the last dump is too recent; ")
    bench.recorder.box._ask_from = 0.0
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.recorder.box, "_begin", broken)
        bench.recorder.box.dump(refused.append)
    assert refused[2] == "KeyError('a defect')"
    await bench.drive(1.0)


def test_a_ring_holds_the_latest_and_a_dump_of_it_is_a_beginning(tmp_path: Path) -> None:
    bench = record(tmp_path / "rec", asked, keep_s=4.0)
    assert not bench.recorder.failing
    (ring,) = (path for path in (tmp_path / "rec").iterdir() if not path.name.startswith(DUMP))
    dumps = sorted((tmp_path / "rec").glob(f"{DUMP}*-asked"))
    assert len(dumps) == 1
    assert not (ring / "000000.lumirec").exists()
    for folder in (ring, *dumps):
        said = replayed(folder, tmp_path / f"out-{folder.name}")
        assert said["recorded_run"]["differ"] == 0, said["recorded_run"]
        assert 30 <= said["recorded_run"]["cycles"] < 100
    for method in ("paper", "pic"):  # neither goes on in the state of the daemon's own
        other = replayed(dumps[0], tmp_path / method, "--method", method)
        assert other["recorded_run"] is None
        notes = other["log"]["report"]["notes"]
        assert any(note.startswith(f"method {method} begins with an empty map") for note in notes)
        assert other["counts"]["matched"] > 20


async def unplugged(bench: Bench) -> None:
    """The lidar goes; the fault is told, and its dump follows."""
    await bench.drive(4.0)
    let_write(0.05)
    bench.opener.unplug(USB)
    await bench.drive(10.0)
    bench.opener.plug(USB, bench.device)
    await bench.drive(4.0)
    let_write(0.05)


def test_a_fault_makes_a_dump_that_shows_what_became_of_it(tmp_path: Path) -> None:
    record(tmp_path / "rec", unplugged, keep_s=60.0)
    dumps = sorted((tmp_path / "rec").glob(f"{DUMP}*"))
    assert dumps[0].name.endswith("-fault-101")
    said = json.loads((dumps[0] / ABOUT).read_text())
    assert said["faults"][0] == 101
    compared = replayed(dumps[0], tmp_path / "out")["recorded_run"]
    assert compared["differ"] == 0, compared
    assert compared["cycles"] > 70, "eight seconds, five of them since the fault"


async def unplugged_at_the_end(bench: Bench) -> None:
    """The lidar goes, and somebody starts the service anew before the dump is due."""
    await bench.drive(4.0)
    let_write(0.05)
    bench.opener.unplug(USB)
    await bench.drive(flight_recorder.AFTER_S - 1.0)
    assert bench.recorder.box._pending is not None


def test_a_dump_that_is_due_after_the_stop_is_made_at_the_stop(tmp_path: Path) -> None:
    record(tmp_path / "rec", unplugged_at_the_end, keep_s=60.0)
    (ring,) = (path for path in (tmp_path / "rec").iterdir() if not path.name.startswith(DUMP))
    again = tmp_path / "rec" / "again"
    again.mkdir()
    Flight(again, 60.0).close(ended=True)
    assert not ring.exists(), "the next start has taken it away"
    (dump,) = (tmp_path / "rec").glob(f"{DUMP}*-fault-101")
    assert json.loads((dump / ABOUT).read_text())["faults"][0] == 101
    compared = replayed(dump, tmp_path / "out")["recorded_run"]
    assert compared["differ"] == 0, compared
    assert compared["published_with"]["101"] > 5


async def lit(bench: Recorded) -> None:
    await bench.until(decoded, 6.0)
    for _ in range(3):
        await bench.drive(1.5)
        let_write(0.05)


def test_with_lights(tmp_path: Path) -> None:
    bench = record_lit(tmp_path / "rec", lit, lidar=True)
    assert not bench.recorder.failing
    (run,) = (tmp_path / "rec").iterdir()
    last = sorted(run.glob("*.lumistate"))[-1]
    for segment in run.glob("*.lumirec"):
        if segment.stem < last.stem:
            segment.unlink()
    compared = replayed(run, tmp_path / "out")["recorded_run"]
    assert compared["differ"] == 0, compared
    assert compared["cycles"] > 10


@pytest.mark.parametrize("scans", [1, 2, 5])
def test_who_joins_a_line_hears_the_last_pieces_that_ended_scans_whole(scans: int) -> None:
    """A piece may hold several scans, and the beginning of the next."""
    line = flight_recorder.Line()
    line.passed(Kind.OPEN, 0.0, b"port")
    line.passed(Kind.RX, 0.0, b"PP")
    for number in range(10):
        line.passed(Kind.RX, float(number), b"middle")
        line.passed(Kind.RX, number + 0.5, b"end, and the next begins")
        for _ in range(scans):
            line.scan()
    line.passed(Kind.RX, 10.0, b"more")
    said = [(frame.t_mono, frame.payload) for frame in frames_in(line.said())]
    assert said[:2] == [(0.0, b"port"), (0.0, b"PP")]
    assert [t for t, _ in said][-6:] == [7.5, 8.0, 8.5, 9.0, 9.5, 10.0]
    assert len(said) <= 12, "and the first scan, with which the opening ends"


def test_everything_that_a_cycle_remembers_is_kept_or_left_out_on_purpose() -> None:
    async def cycle() -> set[str]:
        bench = Bench(Path(tempfile.mkdtemp()))
        bench.recorder.close()
        return set(vars(bench.daemon.cycle))

    left_out = {"parts", "cycle_us", "failing", "stage_timer", "timing", "_switched", "_held"}  # their jobs are kept
    left_out |= {"_state_log"}  # of lines in the log alone
    assert run_virtual(cycle()) == {*CYCLE_PARTS, *left_out}


def test_a_ring_whose_run_was_killed_is_kept_as_a_dump_and_one_that_ended_goes(tmp_path: Path) -> None:
    def run(ended: bool) -> Path:
        writer = SegmentWriter(tmp_path, "run", {"recording": "x"})
        flight = Flight(writer.folder, 600.0)
        writer.put(Kind.RX, 0, 1.0, b"abc")
        writer.close()
        flight.close(ended)
        return writer.folder

    run(ended=True)
    run(ended=False)
    assert [path.name for path in tmp_path.iterdir()] == ["run-2"], "the ended one has gone"
    run(ended=True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["dump-run-2-died", "run"]
    (frame,) = open_recording(tmp_path / "dump-run-2-died").frames(LogReport())
    assert frame.payload == b"abc"


def test_a_defect_of_the_flight_recorder_is_a_fault_and_the_cycle_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(checkpoint, "capture", broken)
    bench = record(tmp_path / "rec", long)
    assert bench.snapshots[-1].pose is not None
    assert bench.recorder.failing == {"flight recorder"}
    assert bench.snapshots[-1].condition is not None
    assert Fault.FLIGHT_RECORDER_FAILED in bench.snapshots[-1].condition.faults  # the drives begin anew: wheels jump
    assert caplog.text.count("the flight recorder has failed") == 1


def test_a_damaged_state_is_told_and_named(tmp_path: Path) -> None:
    record(tmp_path / "rec", long)
    state = states(tmp_path / "rec")[-1]
    for segment in state.parent.glob("*.lumirec"):
        if segment.stem < state.stem:
            segment.unlink()
    data = bytearray(state.read_bytes())
    data[-20] ^= 0x10
    state.write_bytes(data)
    with pytest.raises(DataInvalid, match=f"{state.name}: damaged"):
        replay(open_log(state.parent), Config())


def test_a_dump_whose_states_are_of_another_version_is_refused_with_the_remedy(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    record(tmp_path / "rec", long)
    folder, start = tmp_path / "rec", struct.Struct("<8sHI")
    assert states(folder)
    for state in states(folder):
        data = bytearray(state.read_bytes())
        magic, version, length = start.unpack_from(data)
        assert version == state_file.VERSION
        start.pack_into(data, 0, magic, version - 1, length)
        end = start.size + length
        struct.pack_into("<I", data, end, zlib.crc32(data[:end]))
        state.write_bytes(data)
    assert parser.main(["replay", str(folder), "--out", str(tmp_path / "whole")]) == console.OK
    first = states(folder)[0]
    for segment in first.parent.glob("*.lumirec"):
        if segment.stem < first.stem:
            segment.unlink()
    assert parser.main(["replay", str(folder), "--out", str(tmp_path / "part")]) == console.FAILED
    said = capsys.readouterr().err
    assert f"format version {state_file.VERSION - 1}; this program reads version {state_file.VERSION}" in said
    assert "replay it with the version of lumiloop that recorded it" in said
