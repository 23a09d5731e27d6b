"""Maps saved by themselves: when, and what follows where their folder cannot be used."""

import asyncio
import errno
import logging
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from daemon.maps import autosave
from daemon.maps.autosave import (
    ADRIFT,
    EVERY_S,
    FIRST_S,
    FIXED,
    LOOK_S,
    NO_FOLDER,
    NO_MAP,
    RETRY_S,
    About,
    MapAutosaver,
)
from daemon.maps.schema import read
from daemon.maps.store import Start, Store
from estimator.state import new_state
from tests.daemon.maps.autosave_bench import Bench
from tests.daemon.support.map_maker import content


async def test_saved_after_a_minute_then_every_five_and_only_if_something_has_changed(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    await bench.turn(FIRST_S - 1.0)
    assert bench.files == 0
    await bench.turn(1.0)
    assert bench.autosaver.saves == 1
    await bench.turn(2.0 * EVERY_S)
    assert bench.autosaver.saves == 1, "nothing has changed"
    bench.drive()
    await bench.turn(0.0)
    assert bench.autosaver.saves == 2
    bench.drive()
    await bench.turn(EVERY_S - 1.0)
    assert bench.autosaver.saves == 2
    await bench.turn(1.0)
    assert bench.autosaver.saves == 3


async def test_what_is_saved_says_whose_it_is(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    await bench.turn(FIRST_S)
    start = Store(tmp_path).load()
    assert start is not None
    meta = start.stored.meta
    assert (meta.map_id, meta.robot, meta.survey, meta.session) == (0x77, "robot", "digest", 1)
    assert meta.saved == pytest.approx(1.5e9 + bench.clock.t)
    assert bench.store is not None
    bench.store.close()
    later = Bench(tmp_path, about=About(), start=start)
    later.drive()
    await later.turn(FIRST_S)
    again = Store(tmp_path).load()
    assert again is not None
    assert (again.stored.meta.session, again.stored.meta.survey) == (2, "digest")


async def test_done_is_said_when_it_is_on_the_disk(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    bench.autosaver.ask(lambda reason: bench.told.append(f"{reason}{bench.files}"))
    bench.autosaver.ask(lambda reason: bench.told.append(f"{reason}{bench.files}"))
    assert bench.told == []
    for _ in range(2):
        await bench.turn()
    assert bench.told == ["1", "2"], "the second was asked while the first was under way: it may know more"


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda bench: setattr(bench, "state", None), NO_MAP),
        (lambda bench: setattr(bench, "state", new_state()), NO_MAP),
        (lambda bench: bench.autosaver.loaded(), ADRIFT),
    ],
)
async def test_what_cannot_be_saved_is_refused_with_the_reason(
    tmp_path: Path, change: Callable[[Bench], None], reason: str
) -> None:
    bench = Bench(tmp_path, start=Start(content(), read(content())))
    change(bench)
    bench.autosaver.ask(bench.told.append)
    assert bench.told == [reason]


async def test_without_a_folder_and_for_localisation_only_it_is_refused(tmp_path: Path) -> None:
    for bench, reason in (
        (Bench(tmp_path, kept=False), NO_FOLDER),
        (Bench(tmp_path, about=About(localise=True)), FIXED),
    ):
        bench.drive()
        bench.autosaver.ask(bench.told.append)
        await bench.turn(10.0 * EVERY_S)
        await bench.autosaver.finish()
        assert bench.told == [reason]
        assert bench.files == 0


async def test_a_disk_that_cannot_be_written_is_said_once_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    bench = Bench(tmp_path)
    assert bench.store is not None
    save = bench.store.save

    def full(data: bytes, map_id: int) -> Path:
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(bench.store, "save", full)
    bench.drive()
    bench.autosaver.ask(bench.told.append)
    for _ in range(3):
        await bench.turn(RETRY_S)
    assert "Read-only file system" in bench.told[0]
    assert "Read-only file system" in bench.autosaver.error
    assert caplog.text.count("the map cannot be saved") == 1
    monkeypatch.setattr(bench.store, "save", save)
    with caplog.at_level(logging.INFO):
        await bench.turn(RETRY_S)
    assert bench.autosaver.error == ""
    assert bench.autosaver.saves == 1
    assert "map saved" in caplog.text


async def test_a_defect_in_the_packing_is_told_in_full_and_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    monkeypatch.setattr(bench.autosaver, "_packed", lambda image: 1 // 0)
    await bench.turn(FIRST_S)
    assert "ZeroDivisionError" in bench.autosaver.error
    assert "Traceback" in caplog.text
    monkeypatch.undo()
    await bench.turn(RETRY_S)
    assert bench.autosaver.saves == 1


@pytest.mark.parametrize("failure", [RuntimeError("can't start new thread"), MemoryError()])
async def test_a_save_that_cannot_begin_is_told_and_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    await bench.turn(FIRST_S)
    bench.state, bench.map_id = new_state(), 0x78

    def fail(*given: object) -> None:
        raise failure

    with monkeypatch.context() as without:
        without.setattr(*((threading.Thread, "start") if str(failure) else (bench.autosaver, "_image")), fail)
        bench.drive()
        bench.state.map.keyframes[0] = None  # type: ignore[assignment]  # there is something of a map
        bench.autosaver.ask(bench.told.append)
        bench.state.map.keyframes.clear()
    assert len(bench.told) == 1
    assert repr(failure) in bench.told[0]
    assert repr(failure) in bench.autosaver.error
    assert bench.autosaver.busy_since is None
    await bench.turn(RETRY_S)
    assert bench.autosaver.error == ""
    assert bench.autosaver.saves == 2, "begun anew, which must not be forgotten"


async def test_reset_is_kept_at_once_so_that_the_old_map_does_not_come_back(tmp_path: Path) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    await bench.turn(FIRST_S)
    bench.state, bench.map_id = new_state(), 0x78
    await bench.turn(1.0)
    assert bench.autosaver.saves == 2
    start = Store(tmp_path).load()
    assert start is not None
    assert start.stored.meta.map_id == 0x78
    assert len(start.stored.tables["submap.key"]) == 0
    assert bench.files == 2, "the old one stays as a map of its own"
    await bench.turn(10.0 * EVERY_S)
    assert bench.autosaver.saves == 2


async def test_a_reset_that_could_not_be_kept_is_tried_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    await bench.turn(FIRST_S)
    bench.state, bench.map_id = new_state(), 0x78
    packed = bench.autosaver._packed
    monkeypatch.setattr(bench.autosaver, "_packed", lambda image: 1 // 0)
    await bench.turn(1.0)
    monkeypatch.setattr(bench.autosaver, "_packed", packed)
    await bench.turn(RETRY_S)
    assert bench.autosaver.saves == 2
    assert bench.files == 2


async def test_a_map_just_loaded_is_not_saved_until_the_robot_knows_its_place_in_it(tmp_path: Path) -> None:
    bench = Bench(tmp_path, start=Start(content(), read(content())))
    bench.autosaver.loaded()
    assert bench.state is not None
    bench.state.map.next_key += 9
    await bench.turn(EVERY_S)
    await bench.autosaver.finish()
    assert bench.files == 0
    bench.drive()
    await bench.turn(EVERY_S)
    assert bench.files == 1


async def test_at_the_stop_what_is_new_is_saved_and_told_and_the_folder_is_free(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    await bench.turn(FIRST_S)
    bench.drive()
    caplog.clear()
    with caplog.at_level(logging.INFO):
        await bench.autosaver.finish()
    assert caplog.text.count("map saved") == 1
    assert bench.files == 2
    await bench.autosaver.finish()
    assert bench.files == 2
    Store(tmp_path).save(content(), 5)


async def test_a_stop_does_not_wait_for_ever(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    bench = Bench(tmp_path)
    bench.drive()
    monkeypatch.setattr(autosave, "STOP_S", 0.1)
    monkeypatch.setattr(bench.autosaver, "_packed", lambda image: time.sleep(0.6))
    await bench.autosaver.finish()
    assert "the previous one remains" in caplog.text
    await asyncio.sleep(0.7)


def second(folder: Path) -> tuple[Store, Bench]:
    """A store that holds a folder of maps, and a bench that has asked for it in vain."""
    other, bench = Store(folder), Bench(folder)
    other.claim()
    assert bench.store is not None
    bench.store.claim()
    return other, bench


async def test_a_map_that_was_refused_is_a_fault_until_one_is_saved(tmp_path: Path) -> None:
    tmp_path.joinpath("map-00000077-00000001.lumimap").write_bytes(b"x")
    bench = Bench(tmp_path)
    assert bench.store is not None
    bench.store.load()
    assert bench.autosaver.refused
    bench.drive()
    await bench.turn(FIRST_S)
    assert not bench.autosaver.refused


async def test_a_folder_of_another_process_is_a_fault_from_the_start_until_a_save_is_done(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other, bench = second(tmp_path)
    autosaver = MapAutosaver(bench.store, None, lambda: bench.state, lambda: 0x77, About(), bench.clock)
    assert autosaver.fault
    bench.autosaver = autosaver
    bench.drive()
    await bench.turn(FIRST_S)
    assert autosaver.fault
    assert caplog.text.count("another process stores its maps there") == 1
    await autosaver.finish()
    assert "the daemon tries again" not in caplog.text
    other.close()
    bench.drive()
    await bench.turn(RETRY_S)
    assert not autosaver.fault
    assert bench.files == 1


@pytest.mark.parametrize("loaded", [True, False])
def test_a_folder_that_has_become_free_is_no_fault_any_more_though_there_is_nothing_to_save(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, loaded: bool
) -> None:
    async def run() -> None:
        other = Store(tmp_path)
        other.claim()
        bench = Bench(tmp_path, state=new_state() if loaded else None)
        assert bench.store is not None
        bench.store.claim()
        bench.autosaver = autosaver = MapAutosaver(
            bench.store, None, lambda: bench.state, lambda: 0x77, About(), bench.clock
        )
        for _ in range(3):
            await bench.turn(LOOK_S)
            assert autosaver.fault
        assert caplog.text.count("another process stores its maps there") == 1
        other.close()
        await bench.turn(LOOK_S)
        assert not autosaver.fault
        assert (bench.files, autosaver.busy_since) == (0, None)
        third = Store(tmp_path)
        third.claim()
        assert "another process" in third.trouble, "it is ours now"
        await autosaver.finish()

    with caplog.at_level(logging.INFO):
        asyncio.run(run())
    assert f"maps can be stored in {tmp_path} from now on" in caplog.text


async def test_what_is_wrong_with_the_folder_may_change(tmp_path: Path) -> None:
    folder = tmp_path / "maps"
    folder.write_text("no folder")
    bench = Bench(folder)
    assert bench.store is not None
    bench.store.claim()
    bench.autosaver = MapAutosaver(bench.store, None, lambda: None, lambda: 0x77, About(), bench.clock)
    first = bench.autosaver.error
    folder.unlink()
    other = Store(folder)
    other.claim()
    await bench.turn(LOOK_S)
    assert bench.autosaver.error not in ("", first)
    assert "another process" in bench.autosaver.error
    other.close()
    await bench.turn(LOOK_S)
    assert bench.autosaver.error == ""
    await bench.autosaver.finish()


async def test_a_save_that_was_asked_for_and_failed_is_tried_again_though_nothing_is_new(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    bench = Bench(tmp_path)
    assert bench.store is not None
    bench.drive()
    await bench.turn(FIRST_S)

    def full(data: bytes, map_id: int) -> Path:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as without:
        without.setattr(bench.store, "save", full)
        bench.autosaver.ask(bench.told.append)
        await bench.turn()
        await bench.turn(RETRY_S)
    assert bench.autosaver.fault
    await bench.turn(RETRY_S)
    assert not bench.autosaver.fault
    assert bench.autosaver.saves == 2
    await bench.turn(10.0 * EVERY_S)
    assert bench.autosaver.saves == 2


async def test_at_the_stop_what_there_is_is_saved_though_the_folder_has_not_been_looked_at(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other, bench = second(tmp_path)
    other.close()
    bench.drive()
    bench.clock.t += LOOK_S
    await bench.autosaver.finish()
    assert bench.files == 1
    assert "could not be saved" not in caplog.text
