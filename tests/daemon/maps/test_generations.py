"""Nothing good is deleted, and a stored map without a place in the survey is kept and named."""

import errno
import logging
import os
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from daemon.maps import generations, store
from daemon.maps.autosave import ADRIFT, EVERY_S, FIRST_S
from daemon.maps.container import VERSION
from daemon.maps.generations import BROKEN
from daemon.maps.map_fallback import another, let_go
from daemon.maps.schema import read
from daemon.maps.store import MOST_BROKEN, Start, Store
from daemon.system.regular_file import read_regular
from estimator.mapping.map_parts import Trial
from estimator.relocalisation import unaligned_map
from estimator.relocalisation.hypothesis_tracking import Seek
from estimator.result import Loop, LoopReason, StepResult
from tests.daemon.maps.autosave_bench import Bench
from tests.daemon.maps.test_store import MAP, name, names, store_with
from tests.daemon.runtime.test_cycle import Bench as Cycling
from tests.daemon.runtime.test_cycle import on_bench
from tests.daemon.support.map_maker import Shape, content

FAILURES: list[BaseException] = [
    OSError(errno.EIO, os.strerror(errno.EIO)),
    PermissionError(errno.EACCES, os.strerror(errno.EACCES)),
    OSError(errno.EMFILE, os.strerror(errno.EMFILE)),
    MemoryError(),
]


def of_newer_version(seed: int = 9, shape: Shape | None = None) -> bytes:
    data = bytearray(content(seed=seed) if shape is None else content(shape))
    data[8:10] = struct.pack("<H", VERSION + 1)
    return bytes(data)


def failing(path: Path, failure: BaseException, times: int) -> Callable[[Path, int], bytes]:
    """Reads files, and fails so often with one of them."""
    left = [times]

    def reads(where: Path, most: int) -> bytes:
        if where == path and left[0] > 0:
            left[0] -= 1
            raise failure
        return read_regular(where, most)

    return reads


def saved(keeper: Store, seeds: range) -> None:
    for seed in seeds:
        keeper.save(content(seed=seed), MAP)


def test_a_map_of_a_newer_version_outlasts_all_saves_and_starts(tmp_path: Path) -> None:
    store_with(tmp_path, 1, 2).close()
    newer = tmp_path / name(9)
    newer.write_bytes(of_newer_version())
    for run in range(3):
        keeper = Store(tmp_path)
        keeper.claim()
        start = keeper.load()
        assert start is not None
        saved(keeper, range(3, 7))
        keeper.close()
        assert newer.read_bytes() == of_newer_version()
        begun = [name(2 if run == 0 else 9 + 4 * run)]
        last = [name(9 + 4 * run + 3), name(9 + 4 * run + 4)]
        assert set(names(tmp_path)) == {name(9), *begun, *last}, "it counts as none of the generations"


@pytest.mark.parametrize("times", [1, 1000])
@pytest.mark.parametrize("failure", FAILURES, ids=repr)
def test_a_map_that_could_not_be_read_at_the_start_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: BaseException, times: int
) -> None:
    store_with(tmp_path, 1, 2, 3).close()
    newest = tmp_path / name(3)
    reads = failing(newest, failure, times)
    monkeypatch.setattr(store, "read_regular", reads)
    monkeypatch.setattr(generations, "read_regular", reads)
    keeper = Store(tmp_path)
    keeper.claim()
    start = keeper.load()
    assert start is not None
    assert start.content == content(seed=2)
    saved(keeper, range(4, 9))
    assert newest.read_bytes() == content(seed=3)
    assert names(tmp_path) == [name(2), name(3), name(7), name(8)]


@pytest.mark.parametrize("failure", FAILURES, ids=repr)
def test_a_map_that_cannot_be_read_before_it_is_deleted_is_kept_with_the_one_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, failure: BaseException
) -> None:
    """Of another map, which is read only to find out what may go."""
    store_with(tmp_path, 1, 2, 3).close()
    (tmp_path / name(1)).write_bytes(content(seed=1))
    newest = tmp_path / name(3)
    monkeypatch.setattr(generations, "read_regular", failing(newest, failure, 1))
    keeper = Store(tmp_path)
    for _ in range(3):
        keeper.save(content(Shape(map_id=5)), 5)
    assert names(tmp_path) == [name(5, 5), name(6, 5), name(2), name(3)]
    assert caplog.text.count(f"{newest} cannot be used") == 1


def test_the_only_generation_of_many_other_maps_stays_where_it_is_of_a_newer_version(tmp_path: Path) -> None:
    keeper = Store(tmp_path)
    first = tmp_path / name(1, 1)
    first.write_bytes(of_newer_version(shape=Shape(map_id=1)))
    for map_id in range(2, 12):
        keeper.save(content(Shape(map_id=map_id)), map_id)
    assert first.exists()
    assert len(names(tmp_path)) == 1 + 1 + generations.OTHERS


def test_a_good_map_that_was_moved_aside_is_not_deleted_with_damaged_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keeper = store_with(tmp_path, 1, 2)
    aside = (tmp_path / name(1)).rename(tmp_path / name(1, more=BROKEN))
    write = store.write_whole
    monkeypatch.setattr(store, "write_whole", lambda path, data: write(path, data[:-50] + bytes(50)))
    for _ in range(MOST_BROKEN + 2):
        with pytest.raises(store.Damaged):
            keeper.save(content(seed=2), MAP)
    assert aside.exists()
    assert len(list(tmp_path.glob(f"*{BROKEN}"))) == MOST_BROKEN + 1


def test_a_generation_that_cannot_be_deleted_does_not_fail_the_save(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    keeper = store_with(tmp_path, 1, 2)

    def refuses(path: Path, missing_ok: bool = False) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS))

    monkeypatch.setattr(Path, "unlink", refuses)
    assert keeper.save(content(seed=3), MAP).read_bytes() == content(seed=3)
    assert f"{tmp_path / name(1)} cannot be deleted: Read-only file system" in caplog.text


def test_numbers_go_on_behind_eight_digits(tmp_path: Path) -> None:
    (tmp_path / name(99_999_999)).write_bytes(content(seed=1))
    keeper = Store(tmp_path)
    for seed in range(2, 5):
        keeper.save(content(seed=seed), MAP)
    keeper.close()
    assert names(tmp_path) == sorted(f"map-{MAP:08x}-{10**8 + k}.lumimap" for k in (1, 2))
    start = Store(tmp_path).load()
    assert start is not None
    assert start.content == content(seed=4)


def test_what_is_no_regular_file_is_passed_over_and_stays(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    os.mkfifo(tmp_path / name(7))
    (tmp_path / name(8)).mkdir()
    (tmp_path / name(9)).symlink_to(name(9))
    (tmp_path / name(10)).symlink_to("/dev/zero")
    keeper = Store(tmp_path)
    keeper.claim()
    start = keeper.load()
    assert start is not None
    assert start.content == content(seed=1)
    saved(keeper, range(2, 6))
    assert set(names(tmp_path)) == {name(k) for k in (1, 7, 8, 9, 10, 13, 14)}


NOW = StepResult(1.0, np.zeros(3), np.zeros(3), np.eye(3), np.zeros(3), np.ones(3), None, -1, None, 0, np.zeros(3), 0)
ASIDE = replace(NOW, aside=True)
GONE = replace(NOW, let_go=1)
FOUND = replace(NOW, loop=Loop(1, 9, 2, 0.01, LoopReason.PLACED))


def test_each_turn_of_it_is_said_once_with_the_map_that_it_is_of(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level(logging.INFO)
    steps = [NOW, ASIDE, ASIDE, FOUND, ASIDE, NOW, ASIDE, GONE, GONE]
    gone = [let_go(before, now, 0xABC) for before, now in zip([None, *steps], steps, strict=False)]
    assert [k for k, one in enumerate(gone) if one] == [7]
    said = [record.levelname for record in caplog.records]
    assert said == ["INFO", "INFO", "INFO", "INFO", "WARNING"], "a RESET ends it without a word"
    assert all("00000abc" in record.getMessage() for record in caplog.records)
    assert "was found. The map is now aligned" in caplog.records[1].getMessage()
    assert "was not found" in caplog.records[-1].getMessage()


@pytest.mark.jit
def test_a_map_that_was_let_go_of_is_followed_by_one_of_another_identity() -> None:
    async def work(bench: Cycling) -> None:
        await bench.drive(0, 10)
        step = bench.cycle.parts.step
        bench.cycle.parts.step = lambda records, limits: later(step(records, limits))
        await bench.drive(10, 5)

    def later(result: StepResult) -> StepResult:
        return replace(result, let_go=1)

    bench = on_bench(work)
    ids = [snapshot.map_id for snapshot in bench.snapshots]
    assert len(set(ids)) == 2
    step = next(record for record in bench.records if record.scan == 10)
    assert step.result is not None
    assert ids[-1] == another(ids[0], step.result.t_mono) != another(ids[0], step.result.t_mono + 10.0)


async def test_a_map_set_aside_is_not_saved_over_and_what_follows_it_has_a_file_of_its_own(tmp_path: Path) -> None:
    store = Store(tmp_path)
    stored = content(Shape(map_id=0x77))
    old = store.save(stored, 0x77)
    store.close()
    bench = Bench(tmp_path, start=Start(stored, read(stored)))
    state = bench.state
    assert state is not None
    first = max(state.map.graph.submaps)
    state.map.parts.detached, since = first, state.map.graph.submaps[first].first
    bench.autosaver.loaded()
    unaligned_map.set_aside(state, Trial(first=first, since=since), 0.0, Seek())
    state.map.next_key += 30
    await bench.turn(FIRST_S)
    await bench.turn(2.0 * EVERY_S)
    assert bench.autosaver.saves == 0
    bench.autosaver.ask(bench.told.append)
    assert bench.told == [ADRIFT]
    state.map.parts.aside, bench.map_id = None, 0x78
    await bench.turn(1.0)
    assert bench.autosaver.saves == 1
    assert old.read_bytes() == stored
    ids = sorted(one.map_id for one in Store(tmp_path).generations())
    assert ids == [0x77, 0x78]
