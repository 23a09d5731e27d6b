"""The pose that is kept for the next start: what is written, what survives a kill in mid-write, what is passed over."""

import errno
import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.maps import last_pose
from daemon.maps.last_pose import FILE, WRITE_S, LastPose, Remembered, packed, read, unpacked
from daemon.snapshot import Snapshot, State

TRACKING = Snapshot(1, 0.0, 0.0, 1.7e9, State.TRACKING, 0, pose=(1.0, 2.0, 0.5), map_id=7)


def at(t: float, x: float, state: State = State.TRACKING, map_id: int = 7) -> Snapshot:
    return replace(TRACKING, t_sent=t, pose=(x, 2.0, 0.5), state=state, map_id=map_id)


def kept(folder: Path, *snapshots: Snapshot) -> LastPose:
    """Keep what these say, to the end; the next run's view of it."""
    pose = LastPose(folder)
    pose.start()
    for snapshot in snapshots:
        pose.on_snapshot(snapshot)
    pose.close()
    return LastPose(folder)


def test_the_pose_of_one_run_is_known_to_the_next(tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    assert LastPose(folder).of_map(7) is None
    after = kept(folder, at(0.0, 1.0), at(1.0, 1.5), at(2.0, 2.5))
    assert after.of_map(7) == (2.5, 2.0, 0.5)
    assert after.of_map(8) is None, "of another map it says nothing"
    again = kept(folder, at(10.0, 4.0))
    assert again.of_map(7) == (4.0, 2.0, 0.5)
    assert again.before is not None
    assert again.before.number > (after.before.number if after.before else 0)


def test_what_has_not_moved_is_not_written_and_what_moves_is_written_a_few_times_a_second(tmp_path: Path) -> None:
    pose = LastPose(tmp_path)
    for k in range(1000):
        pose.on_snapshot(at(0.025 * k, 1.0 + 0.001 * (k % 3)))
    assert pose._number == 1
    for k in range(1000):
        pose.on_snapshot(at(25.0 + 0.025 * k, 1.0 + 0.02 * k))
    assert pose._number == pytest.approx(1 + 25.0 / WRITE_S, abs=20)
    before = pose._number
    pose.on_snapshot(at(60.0, 1.0, map_id=9))
    assert pose._number == before + 1


def test_a_pose_that_was_lost_is_forgotten_and_one_that_is_being_found_again_is_not(tmp_path: Path) -> None:
    assert kept(tmp_path, at(0.0, 1.0), at(1.0, 1.0, State.LOST)).of_map(7) is None
    assert kept(tmp_path, at(0.0, 3.0)).of_map(7) == (3.0, 2.0, 0.5)
    assert kept(tmp_path, at(0.0, 0.0, State.RELOCATING), at(1.0, 0.0, State.NO_LIDAR)).of_map(7) == (3.0, 2.0, 0.5)
    assert kept(tmp_path, at(0.0, 3.5), at(1.0, 0.0, State.NO_LIDAR)).of_map(7) == (3.5, 2.0, 0.5)


def test_a_slot_that_is_half_written_leaves_the_one_before(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, second = Remembered(7, (1.0, 0.0, 0.0), 1.7e9, 4), Remembered(7, (2.0, 0.0, 0.0), 1.7e9, 5)
    file = tmp_path / FILE
    for cut in range(64):
        file.write_bytes(packed(first) + packed(second)[:cut] + packed(Remembered(7, (0.5, 0.0, 0.0), 0.0, 3))[cut:])
        found = read(file)
        assert found is not None
        assert found.number in (3, 4, 5)
        assert found.number == 5 or found == first
    file.write_bytes(packed(first) + packed(second))
    assert read(file) == second
    assert not caplog.text
    file.write_bytes(packed(first)[:30])
    assert read(file) is None
    assert caplog.messages == [f"{file} is damaged; the whole map is searched for the robot"]


@given(content=st.binary(max_size=200))
def test_no_file_however_damaged_does_harm(content: bytes) -> None:
    assert unpacked(content) is None


def test_a_disk_that_cannot_be_written_is_said_once_and_tried_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    file = tmp_path / "file"
    file.write_text("")
    pose = LastPose(file / "maps")
    pose.start()
    for k in range(5):
        pose.on_snapshot(at(float(k), float(k)))
        time.sleep(0.02)
    end = time.monotonic() + 5.0
    while not pose.error and time.monotonic() < end:
        time.sleep(0.01)
    assert "Not a directory" in pose.error
    file.unlink()
    pose.on_snapshot(at(9.0, 9.0))
    pose.close()
    assert LastPose(file / "maps").of_map(7) == (9.0, 2.0, 0.5)
    assert [record.levelname for record in caplog.records] == ["INFO", "INFO"]


def wait_for(condition: Callable[[], object]) -> None:
    end = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.002)


@pytest.mark.parametrize("call", ["pwrite", "fdatasync"])
@pytest.mark.parametrize("failure", [OSError(errno.EIO, "Input/output error"), MemoryError()])
def test_a_robot_that_stands_has_its_pose_written_again_after_a_failure(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    call: str,
    failure: Exception,
) -> None:
    caplog.set_level(logging.INFO)
    monkeypatch.setattr(last_pose, "SYNC_S", 0.02)
    monkeypatch.setattr(last_pose, "RETRY_S", 0.02)
    failing, works, synced = threading.Event(), getattr(os, call), threading.Event()
    fdatasync = os.fdatasync

    def fails(*given: Any) -> Any:
        if failing.is_set():
            raise failure
        return works(*given)

    def sync(file: int) -> None:
        (fails if call == "fdatasync" else fdatasync)(file)
        synced.set()

    monkeypatch.setattr(os, call, fails)
    monkeypatch.setattr(os, "fdatasync", sync)
    pose = LastPose(tmp_path)
    pose.start()
    failing.set()
    pose.on_snapshot(at(0.0, 1.0))
    wait_for(lambda: pose.error)
    time.sleep(0.1)  # several retries fail
    assert not synced.is_set()
    failing.clear()
    wait_for(lambda: not pose.error)
    assert synced.is_set()
    assert LastPose(tmp_path).of_map(7) == (1.0, 2.0, 0.5)
    wait_for(lambda: pose.busy_since is None)
    said = "INFO" if isinstance(failure, OSError) else "WARNING"  # a defect has its own line, beside the fault's
    assert [record.levelname for record in caplog.records] == [said, "INFO"], "said once, however often it failed"
    pose.close()


def test_a_file_that_cannot_be_read_is_passed_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / FILE).mkdir()
    assert LastPose(tmp_path).before is None
    assert "cannot be read" in caplog.text


def test_where_maps_are_only_read_the_pose_is_kept_beside_what_else_is_learned(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    maps, learned = tmp_path / "maps", tmp_path / "learned"
    maps.mkdir()
    monkeypatch.setattr("daemon.maps.last_pose.os.access", lambda path, mode: path != maps)  # who tests may be root
    assert LastPose(maps, learned).path == learned / FILE
    assert LastPose(tmp_path / "other", learned).path == tmp_path / "other" / FILE
