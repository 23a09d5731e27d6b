"""The recorder: it keeps what passes, never delays or stops the daemon, and says what it had to leave out."""

import asyncio
import errno
import math
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from daemon.config.schema import Config
from daemon.devices.light_setup import RESIDUALS, Lights
from daemon.recording import disk_writer
from daemon.recording.disk_writer import SegmentWriter
from daemon.recording.recorder import Recorder
from daemon.recording.retention import RING
from estimator.cdma.air_interface import PROFILE_A
from hal.clock import SystemClock
from hal.errors import DeviceMissing, HalError
from hal.port.port import Port, memory_pair
from hal.replay.recording import Frame, Kind, open_recording
from hal.replay.report import LogReport
from tests.daemon.support.map_maker import SURVEY


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.005)
    monkeypatch.setattr(disk_writer, "SYNC_S", 0.01)
    monkeypatch.setattr(disk_writer, "RETRY_S", 0.02)


def read(folder: Path) -> tuple[list[Frame], LogReport]:
    report = LogReport()
    return list(open_recording(folder).frames(report)), report


def wait_for(condition: object, seconds: float = 5.0) -> None:
    assert callable(condition)
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


def writer(folder: Path, **options: int) -> SegmentWriter:
    return SegmentWriter(folder, "run", {"recording": "x"}, **options)


def test_what_was_put_is_on_disk_after_close(tmp_path: Path) -> None:
    out = writer(tmp_path)
    for number in range(1000):
        out.put(Kind.RX, 0, float(number), bytes([number % 256]) * (number % 40))
    out.close()
    out.close()
    frames, report = read(tmp_path)
    assert [frame.t_mono for frame in frames] == list(map(float, range(1000)))
    assert frames[39].payload == b"\x27" * 39
    assert not report.sentences()
    assert (out.records, out.lost, out.error) == (1000, 0, "")


def test_it_is_on_disk_soon_without_close(tmp_path: Path) -> None:
    out = writer(tmp_path)
    out.put(Kind.RX, 0, 1.0, b"abc")
    wait_for(lambda: len(read(tmp_path)[0]) == 1)
    out.close()


def test_segments_rotate_and_each_can_be_read_alone(tmp_path: Path) -> None:
    out = writer(tmp_path, segment_bytes=2000)
    for number in range(60):
        out.put(Kind.RX, 0, float(number), bytes(500))
        wait_for(lambda n=number: out.records == n + 1)
    out.close()
    segments = sorted((tmp_path / "run").iterdir())
    assert len(segments) > 8
    assert len(read(tmp_path)[0]) == 60
    assert 0 < len(read(segments[3])[0]) < 10


class Disk:
    """Stands between the writer and the file system: takes so many bytes and then is full."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.room = 1 << 30
        self._write = os.write
        monkeypatch.setattr(disk_writer.os, "write", self.write)

    def write(self, file: int, data: memoryview) -> int:
        if self.room == 0:
            raise OSError(errno.ENOSPC, "No space left on device")
        taken = self._write(file, data[: min(len(data), self.room)])
        self.room -= taken
        return taken


@pytest.fixture
def small_disk(monkeypatch: pytest.MonkeyPatch) -> Disk:
    return Disk(monkeypatch)


def test_a_full_disk_is_counted_and_said_and_survived(
    tmp_path: Path, small_disk: Disk, caplog: pytest.LogCaptureFixture
) -> None:
    out = writer(tmp_path)
    out.put(Kind.RX, 0, 1.0, b"before")
    wait_for(lambda: out.records == 1)
    small_disk.room = 10  # half a record
    for number in range(5):
        out.put(Kind.RX, 0, 2.0 + number, b"too much")
    wait_for(lambda: out.lost == 5)
    assert "No space left on device" in out.error
    small_disk.room = 1 << 30
    wait_for(lambda: out.error == "")
    out.put(Kind.RX, 0, 9.0, b"after")
    out.close()
    frames, report = read(tmp_path)
    assert [frame.payload for frame in frames if frame.kind == Kind.RX] == [b"before", b"after"]
    (note,) = (frame.payload.decode() for frame in frames if frame.kind == Kind.NOTE)
    assert note.startswith("5 records before this one were lost")
    assert "No space left" in note
    assert not report.skipped  # nothing is torn: what was half written has been cut off
    assert caplog.text.count("has stopped") == 1
    assert caplog.text.count("recording continues in") == 1


def test_memory_that_runs_out_is_counted_and_said_and_survived(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    out = writer(tmp_path)
    write = disk_writer._write_all

    def none_left(file: int, data: bytes) -> None:
        raise MemoryError

    monkeypatch.setattr(disk_writer, "_write_all", none_left)
    out.put(Kind.RX, 0, 1.0, b"lost")
    wait_for(lambda: out.lost == 1)
    assert out.error.endswith("MemoryError()")
    monkeypatch.setattr(disk_writer, "_write_all", write)
    wait_for(lambda: out.error == "")
    out.put(Kind.RX, 0, 2.0, b"after")
    wait_for(lambda: out.busy_since is None and out.records == 1)
    out.close()
    assert [frame.payload for frame in read(tmp_path)[0] if frame.kind == Kind.RX] == [b"after"]
    assert caplog.text.count("has stopped") == 1


def test_a_disk_that_hangs_costs_records_but_no_memory_and_no_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(disk_writer, "BACKLOG_BYTES", 10_000)
    out = writer(tmp_path)
    hang = threading.Event()
    write = os.write

    def stuck(file: int, data: memoryview) -> int:
        hang.wait()
        return write(file, data)

    monkeypatch.setattr(disk_writer.os, "write", stuck)
    out.put(Kind.RX, 0, 0.0, b"caught")
    time.sleep(0.05)
    begun = time.monotonic()
    for number in range(1000):
        out.put(Kind.RX, 0, 1.0 + number, bytes(100))
    assert time.monotonic() - begun < 2.0
    assert out.lost > 900
    hang.set()
    out.close()
    frames, _ = read(tmp_path)
    kept = [frame for frame in frames if frame.kind == Kind.RX]
    assert len(kept) == 1001 - out.lost
    assert [frame.t_mono for frame in kept] == list(map(float, range(len(kept))))


def test_a_folder_that_is_taken_away_is_made_again(tmp_path: Path) -> None:
    out = writer(tmp_path, segment_bytes=100)
    out.put(Kind.RX, 0, 1.0, bytes(200))
    wait_for(lambda: out.records == 1)
    for file in (tmp_path / "run").iterdir():
        file.unlink()
    (tmp_path / "run").rmdir()
    out.put(Kind.RX, 0, 2.0, bytes(200))
    wait_for(lambda: out.records == 2)
    out.close()
    assert [frame.t_mono for frame in read(tmp_path)[0]] == [2.0]


def test_each_run_gets_a_folder_of_its_own(tmp_path: Path) -> None:
    for _ in range(3):
        writer(tmp_path).close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run", "run-2", "run-3"]


@pytest.mark.parametrize("keep_s", [math.inf, 60.0])
def test_a_place_that_cannot_be_written_at_the_start_is_tried_again(
    tmp_path: Path, keep_s: float, caplog: pytest.LogCaptureFixture
) -> None:
    place = tmp_path / "file"
    place.write_text("")
    recorder = Recorder(place, Config(), SystemClock(), Lights(SURVEY, PROFILE_A, None, b"a map"), keep_s=keep_s)
    assert recorder.failing == {"recorder"}
    assert f"recording to {recorder.disk.folder} has stopped: Not a directory" in caplog.text
    recorder.disk.put(Kind.RX, 0, 1.0, b"lost")
    wait_for(lambda: recorder.disk.lost == 1)
    place.unlink()
    wait_for(lambda: not recorder.error)
    recorder.disk.put(Kind.RX, 0, 2.0, b"kept")
    recorder.box.flight.prepare()
    if not math.isinf(keep_s):
        wait_for(lambda: (recorder.disk.folder / RING).exists())
    recorder.close()
    frames, _ = read(place)
    assert [frame.payload for frame in frames if frame.kind == Kind.RX] == [b"kept"]
    assert frames[0].kind == Kind.NOTE
    assert (recorder.disk.folder / RESIDUALS).read_bytes() == b"a map"


def test_the_header_says_what_was_recorded_with_what(tmp_path: Path) -> None:
    Recorder(tmp_path, Config(name="tug-7"), SystemClock()).close()
    header = open_recording(tmp_path).header
    assert header["config"]["name"] == "tug-7"
    assert header["versions"]["numpy"]
    assert header["segment"] == 0


async def test_everything_through_a_port_is_kept_in_order(tmp_path: Path) -> None:
    clock = SystemClock()
    recorder = Recorder(tmp_path, Config(), clock)
    ours, theirs = memory_pair(clock, "/dev/x")

    async def opener(device: str, baud: int) -> Port:
        assert (device, baud) == ("/dev/x", 19200)
        return theirs

    port = await recorder.tap(opener)("/dev/x", 19200)
    got: list[bytes] = []
    lost: list[HalError] = []
    ours.start(lambda data, t_rx: ours.write(b"reply to " + data), lambda error: None)
    port.start(lambda data, t_rx: got.append(data), lost.append)
    port.write(b"VV\n")
    await asyncio.sleep(0.01)
    port.set_baud(115200)
    ours.close()
    await asyncio.sleep(0.01)
    assert got == [b"reply to VV\n"]
    assert len(lost) == 1
    assert isinstance(lost[0], DeviceMissing)
    port.close()
    assert port.name == "/dev/x"
    recorder.close()
    frames, _ = read(tmp_path)
    assert [(Kind(frame.kind).name, frame.payload) for frame in frames] == [
        ("OPEN", b"/dev/x 19200"),
        ("TX", b"VV\n"),
        ("RX", b"reply to VV\n"),
        ("BAUD", b"115200"),
        ("LOST", b"/dev/x: the other end was closed"),
        ("LOST", b"closed"),
    ]


def test_a_port_that_does_not_open_is_passed_on(tmp_path: Path) -> None:
    async def opener(device: str, baud: int) -> Port:
        raise DeviceMissing(device, "not there")

    recorder = Recorder(tmp_path, Config(), SystemClock())
    with pytest.raises(DeviceMissing):
        asyncio.run(recorder.tap(opener)("/dev/x", 0))  # type: ignore[arg-type]  # an opener's call is a coroutine
    recorder.close()


KILLED = """
import os, sys, time
from pathlib import Path
from daemon.recording.disk_writer import SegmentWriter
from hal.replay.recording import Kind
class Telling(SegmentWriter):
    handed = 0
    def _turn(self):
        before = self.handed
        super()._turn()
        os.write(1, b"%d\\n" % before)
out = Telling(Path(sys.argv[1]), "run", {"recording": "x"})
while True:
    out.put(Kind.RX, 0, time.monotonic(), b"%d" % out.handed)
    out.handed += 1
    time.sleep(0.001)
"""
"""Tells, after each time it has written, how many records had been handed over before."""


def test_a_killed_process_leaves_all_that_it_had_begun_to_write(tmp_path: Path) -> None:
    process = subprocess.Popen([sys.executable, "-c", KILLED, str(tmp_path)], stdout=subprocess.PIPE)
    assert process.stdout is not None
    while int(process.stdout.readline()) < 300:
        pass
    process.kill()
    told = process.stdout.read().split()
    process.wait()
    process.stdout.close()
    frames, _ = read(tmp_path)
    assert [frame.payload for frame in frames] == [b"%d" % number for number in range(len(frames))]
    assert len(frames) >= max([300, *map(int, told)])


@pytest.mark.system
@pytest.mark.skipif(os.getuid() != 0, reason="mounting a small file system needs root")
def test_a_really_full_file_system(tmp_path: Path) -> None:
    place = tmp_path / "small"
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=256k", "none", str(place)], check=True)
    try:
        out = writer(place)
        for number in range(100):
            out.put(Kind.RX, 0, float(number), bytes(8000))
            time.sleep(0.006)
        wait_for(lambda: out.lost > 0 and bool(out.error))
        next(iter(sorted((place / "run").iterdir()))).unlink()
        wait_for(lambda: out.error == "")
        out.put(Kind.RX, 0, 1000.0, b"after")
        out.close()
        frames, _ = read(place)
        assert frames[-1].payload == b"after"
    finally:
        subprocess.run(["umount", str(place)], check=True)
