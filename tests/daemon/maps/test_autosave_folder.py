"""A folder of maps that cannot be used: told from the start, tried again, and no fault any more when it is free."""

from __future__ import annotations

import asyncio
import errno
import logging
from pathlib import Path

import pytest

from daemon.maps.autosave import EVERY_S, FIRST_S, LOOK_S, RETRY_S, About, MapAutosaver
from daemon.maps.store import Store
from estimator.state import new_state
from tests.daemon.maps.autosave_bench import Bench


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
