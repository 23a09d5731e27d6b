"""The folder of maps: one process at a time, and disks that are full, lie, or vanish."""

import errno
import fcntl
import logging
import os
import stat
from pathlib import Path

import pytest

from daemon.config.paths import maps_folder
from daemon.config.schema import MapConfig
from daemon.maps import generations
from daemon.maps import store as module
from daemon.maps.container import Damaged
from daemon.maps.initial_state import started
from daemon.maps.store import Store
from tests.daemon.maps.test_store import MAP, name, names, store_with
from tests.daemon.support.map_maker import content


def test_one_process_at_a_time(tmp_path: Path) -> None:
    first = store_with(tmp_path, 1)
    with pytest.raises(BlockingIOError) as caught:
        Store(tmp_path).save(content(), MAP)
    assert "another process" in generations.said(caught.value)
    first.close()
    Store(tmp_path).save(content(), MAP)


def test_deleting_all_files_of_a_folder_leaves_its_lock(tmp_path: Path) -> None:
    first = store_with(tmp_path, 1)
    for path in tmp_path.iterdir():
        path.unlink()
    with pytest.raises(BlockingIOError):
        Store(tmp_path).save(content(), MAP)
    first.save(content(), MAP)


def made_anew(folder: Path) -> None:
    folder.rename(folder.with_name("away"))
    folder.mkdir()


def test_a_folder_that_was_made_anew_has_a_lock_of_its_own(tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    first = store_with(folder, 1)
    made_anew(folder)
    second = Store(folder)
    second.save(content(seed=2), MAP)
    with pytest.raises(BlockingIOError):
        first.save(content(seed=3), MAP)
    first.claim()
    assert "another process stores its maps there" in first.trouble
    second.close()
    first.claim()
    assert first.trouble == ""
    with pytest.raises(BlockingIOError):
        second.save(content(seed=4), MAP)


def test_who_locked_a_folder_locks_the_one_in_its_place(tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    first = store_with(folder, 1)
    made_anew(folder)
    first.save(content(seed=2), MAP)
    with pytest.raises(BlockingIOError):
        Store(folder).save(content(seed=3), MAP)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_said_at_the_start(tmp_path: Path) -> None:
    tmp_path.chmod(0o555)
    store = Store(tmp_path)
    store.claim()
    assert store.trouble.endswith("Permission denied")


def test_a_disk_without_locks_on_folders_locks_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As NFS, which locks only what is open for writing."""
    flock = fcntl.flock

    def nfs(handle: int, kind: int) -> None:
        if stat.S_ISDIR(os.fstat(handle).st_mode):
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        flock(handle, kind)

    monkeypatch.setattr(fcntl, "flock", nfs)
    first = store_with(tmp_path, 1)
    with pytest.raises(BlockingIOError):
        Store(tmp_path).save(content(), MAP)
    first.close()
    Store(tmp_path).save(content(), MAP)


def test_a_folder_that_vanished_is_made_again(tmp_path: Path) -> None:
    store = store_with(tmp_path / "maps", 1)
    for path in (tmp_path / "maps").iterdir():
        path.unlink()
    (tmp_path / "maps").rmdir()
    store.save(content(), MAP)
    assert Store(tmp_path / "maps").load() is not None


def test_what_a_killed_process_has_left_half_written_goes(tmp_path: Path) -> None:
    (tmp_path / f".{name(4)}.part").write_bytes(b"half")
    store_with(tmp_path, 1)
    assert names(tmp_path) == [name(1)]


def test_a_full_disk_leaves_what_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_with(tmp_path, 1)

    def full(handle: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        store.save(content(seed=2), MAP)
    assert names(tmp_path) == [name(1)]


def test_a_disk_that_keeps_lying_is_not_filled_with_what_it_has_spoilt(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = store_with(tmp_path, 1)
    write = module.write_whole
    monkeypatch.setattr(module, "write_whole", lambda path, data: write(path, data[:-50] + bytes(50)))
    for _ in range(module.MOST_BROKEN + 3):
        with pytest.raises(Damaged, match="check the disk"):
            store.save(content(seed=2), MAP)
    last = 1 + module.MOST_BROKEN + 3
    kept = [name(k, more=".broken") for k in range(last - module.MOST_BROKEN + 1, last + 1)]
    assert names(tmp_path) == [name(1), *kept]


def test_a_disk_that_lies_is_found_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = store_with(tmp_path, 1)
    write = module.write_whole
    monkeypatch.setattr(module, "write_whole", lambda path, data: write(path, data[:-50] + bytes(50)))
    with pytest.raises(Damaged, match="check the disk"):
        store.save(content(seed=2), MAP)
    assert names(tmp_path) == [name(1), name(2, more=".broken")]
    start = Store(tmp_path).load()
    assert start is not None
    assert start.content == content(seed=1)


def test_maps_are_kept_in_the_state_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    assert maps_folder("") == tmp_path / "maps"
    assert maps_folder("/srv/maps") == Path("/srv/maps")


def test_a_second_daemon_on_one_folder_is_told_at_its_start(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    settings = MapConfig(folder=str(tmp_path))
    first, _ = started(settings, None)
    assert first is not None
    assert not caplog.messages
    second, _ = started(settings, None)
    assert second is not None
    assert "another process" in second.trouble
    assert f"no map can be stored in {tmp_path}: another process stores its maps there" in caplog.text
    first.close()
    caplog.clear()
    started(settings, None)
    assert not caplog.messages


def test_what_a_killed_run_has_left_and_cannot_be_removed_keeps_nobody_from_the_folder(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stuck, half = tmp_path / f".{name(1)}.part", tmp_path / f".{name(2)}.part"
    stuck.mkdir()  # refuses to be unlinked, as another user's file in a sticky folder does
    half.write_bytes(b"half")
    store = Store(tmp_path)
    store.claim()
    assert store.trouble == ""
    assert not half.exists()
    assert caplog.text.count(f"{stuck} cannot be removed") == 1
    store.claim()
    assert caplog.text.count(f"{stuck} cannot be removed") == 1


def test_a_folder_that_is_back_with_what_was_in_it_is_no_trouble_any_more(tmp_path: Path) -> None:
    folder, away = tmp_path / "maps", tmp_path / "away"
    store = Store(folder)
    store.claim()
    folder.rename(away)
    folder.write_text("no folder")
    store.claim()
    assert store.trouble
    folder.unlink()
    away.rename(folder)
    store.claim()
    assert store.trouble == ""


def test_a_folder_that_cannot_be_read_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file = tmp_path / "file"
    file.write_text("")
    store = Store(file)
    with caplog.at_level(logging.ERROR):
        assert store.load() is None
    assert f"maps in {file} cannot be read: Not a directory; correct that, or name another `map.folder`" in caplog.text
    assert store.refused
