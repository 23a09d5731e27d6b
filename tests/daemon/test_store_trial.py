"""A map that ends every start is set aside after three; one that lasts, or that was stopped in order, never."""

from __future__ import annotations

import asyncio
import errno
import logging
from pathlib import Path

import pytest

from daemon import main, store_keeper, store_trial
from daemon.config import MapConfig
from daemon.main import Daemon, World
from daemon.store import Start, started
from daemon.store_trial import MOST, NAME, PROOF_S
from daemon.warmup import CannotLoad
from hal.clock import LoopClock, run_virtual
from hal.fake.transport import FakeOpener
from tests.daemon.keeping import Bench
from tests.daemon.mapmaker import Shape, content
from tests.daemon.test_daemon import SETTINGS
from tests.daemon.test_store import MAP, name, names, store_with


def begin(folder: Path, proved: bool = False) -> Start | None:
    """One start; it dies, or is proved."""
    store, start = started(MapConfig(folder=str(folder)), None)
    assert store is not None
    store.trial.begin()
    if proved:
        store.trial.proved()
    store.close()
    return start


def test_what_no_start_outlives_is_set_aside_and_the_generation_before_it_has_its_turn(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store_with(tmp_path, 1, 2).close()
    for _ in range(MOST):
        start = begin(tmp_path)
        assert start is not None
        assert start.content == content(seed=2)
    assert not caplog.messages or "refused" not in caplog.text
    start = begin(tmp_path)
    assert start is not None
    assert start.content == content(seed=1)
    assert name(2, more=".broken") in names(tmp_path)
    (said,) = [record for record in caplog.records if record.levelno == logging.ERROR]
    assert name(2, more=".broken") in said.getMessage()
    assert f"{MOST} starts in a row" in said.getMessage()
    for _ in range(MOST - 1):
        assert begin(tmp_path) is not None, "it has as many starts as the one before"
    assert begin(tmp_path) is None, "and without any map there is a start still"


def set_aside(folder: Path) -> None:
    """Both generations of a map, by starts that die."""
    store_with(folder, 1, 2).close()
    for _ in range(2 * MOST):
        assert begin(folder) is not None
    assert begin(folder) is None
    assert names(folder) == [name(1, more=".broken"), name(2, more=".broken")]


def test_what_was_set_aside_is_put_back_where_starts_without_it_do_not_last_either(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    set_aside(tmp_path)
    for _ in range(MOST - 1):
        assert begin(tmp_path) is None
    for _ in range(3 * MOST):
        start = begin(tmp_path)
        assert start is not None
        assert start.content == content(seed=2)
    assert names(tmp_path) == [name(1), name(2)]
    (said,) = [words for words in caplog.messages if "taken again" in words]
    assert name(2) in said
    assert begin(tmp_path, proved=True) is not None
    for _ in range(MOST):
        begin(tmp_path)
    start = begin(tmp_path)
    assert start is not None
    assert start.content == content(seed=1), "on trial again once a start has lasted"


def test_what_was_set_aside_stays_there_where_a_start_without_it_lasts(tmp_path: Path) -> None:
    set_aside(tmp_path)
    assert begin(tmp_path, proved=True) is None
    for _ in range(2 * MOST):
        assert begin(tmp_path) is None
    assert names(tmp_path) == [name(1, more=".broken"), name(2, more=".broken")]


def test_another_map_in_use_is_a_start_without_those_set_aside(tmp_path: Path) -> None:
    """What ends every start takes no second map with it, and the first one comes back."""
    store = store_with(tmp_path, 1)
    store.save(content(Shape(map_id=0x77)), 0x77)
    store.close()
    for _ in range(MOST):
        begin(tmp_path)
    began = [begin(tmp_path) for _ in range(MOST + 1)]
    assert [None if one is None else one.stored.meta.map_id for one in began] == [None, MAP, MAP, 0x77]


def test_a_map_put_back_by_hand_meanwhile_is_not_written_over(tmp_path: Path) -> None:
    set_aside(tmp_path)
    for _ in range(MOST - 1):
        begin(tmp_path)
    (tmp_path / name(2)).write_bytes(content(seed=3))
    start = begin(tmp_path)
    assert start is not None
    assert start.content == content(seed=3)
    assert (tmp_path / name(2, more=".broken")).exists()


def test_a_start_that_lasts_makes_good_for_those_before(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    for number in range(3 * MOST):
        assert begin(tmp_path, proved=number % MOST == MOST - 1) is not None
    assert names(tmp_path) == [name(1)]


def test_a_count_that_cannot_be_begun_anew_sets_nothing_aside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else no generation would be used any more: each would be found to have had its starts."""
    store_with(tmp_path, 1, 2).close()
    for _ in range(MOST):
        begin(tmp_path)

    def full(*_: object, **__: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    start = begin(tmp_path)
    assert start is not None
    assert start.content == content(seed=2)
    assert names(tmp_path) == [name(1), name(2)]


def test_maps_do_not_go_one_after_the_other_where_something_else_ends_every_start(tmp_path: Path) -> None:
    store = store_with(tmp_path, 1)
    store.save(content(Shape(map_id=0x77)), 0x77)
    store.close()
    for _ in range(MOST):
        start = begin(tmp_path)
        assert start is not None
        assert start.stored.meta.map_id == 0x77
    assert begin(tmp_path) is None, "what a person has begun anew does not come back by itself"
    for _ in range(2 * MOST):
        assert begin(tmp_path) is not None
    assert name(1) in names(tmp_path)
    assert begin(tmp_path, proved=True) is not None
    for _ in range(MOST):
        assert begin(tmp_path) is not None
    assert begin(tmp_path) is None, "it is on trial again once a start has lasted"


@pytest.mark.jit
@pytest.mark.parametrize(("room", "counts"), [(False, False), (True, True)])
def test_only_a_start_that_has_come_to_its_map_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, room: bool, counts: bool
) -> None:
    """Where there is no room for kernels no start comes so far, and each is tried anew after ten seconds."""
    store_with(tmp_path, 1).close()
    store, start = started(MapConfig(folder=str(tmp_path)), None)
    assert store is not None

    async def warm_up() -> None:
        if not room:
            raise CannotLoad("no space left on device")

    def ended(*_: object) -> None:
        raise CannotLoad("a defect with this map")

    async def go() -> None:
        clock = LoopClock(asyncio.get_running_loop(), utc_at_zero=1.7e9)
        world = World(clock, opener=FakeOpener(clock), warm_up=warm_up, store=store, start=start)
        await Daemon(SETTINGS, world).run(asyncio.Event())

    monkeypatch.setattr(main, "new_state", ended)
    with pytest.raises(CannotLoad):
        run_virtual(go())
    assert (tmp_path / NAME).exists() is counts


def test_another_run_of_the_computer_counts_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A battery that fails says nothing of the map."""
    folder, boot = tmp_path / "maps", tmp_path / "boot_id"
    monkeypatch.setattr(store_trial, "BOOT", boot)
    store_with(folder, 1).close()
    for number in range(2 * MOST):
        boot.write_text(f"boot-{number}\n")
        assert begin(folder) is not None
    boot.unlink()
    for _ in range(MOST):
        assert begin(folder) is not None
    assert begin(folder) is None


@pytest.mark.parametrize("held", [b"", b"\xff", b"rubbish", f"{MAP:08x} ".encode()])
def test_a_count_that_cannot_be_read_is_none(tmp_path: Path, held: bytes) -> None:
    store_with(tmp_path, 1).close()
    (tmp_path / NAME).write_bytes(held)
    assert begin(tmp_path) is not None


def test_a_folder_that_cannot_be_written_counts_nothing(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    (tmp_path / NAME).mkdir()
    for _ in range(2 * MOST):
        assert begin(tmp_path, proved=True) is not None
        assert begin(tmp_path) is not None


def test_who_only_looks_or_uses_a_map_as_it_is_counts_nothing(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    for _ in range(2 * MOST):
        started(MapConfig(folder=str(tmp_path)), None, mend=False)
        started(MapConfig(folder=str(tmp_path), localise=True), None)
    assert names(tmp_path) == [name(1)]
    assert not (tmp_path / NAME).exists()


def test_a_run_is_proved_when_it_has_lasted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(store_keeper, "BEAT_S", 0.01)

    async def run() -> None:
        store_with(tmp_path, 1).close()
        bench = Bench(tmp_path)
        assert bench.store is not None
        bench.store.claim()
        bench.store.load()
        bench.store.trial.begin()
        bench.keeper.loaded()
        beats = asyncio.create_task(bench.keeper.run())
        bench.clock.t += PROOF_S - 0.1
        await asyncio.sleep(0.1)
        assert (tmp_path / NAME).exists()
        bench.clock.t += 0.1
        async with asyncio.timeout(20.0):
            while (tmp_path / NAME).exists():  # noqa: ASYNC110  # nothing tells of it
                await asyncio.sleep(0.01)
        beats.cancel()

    asyncio.run(run())


@pytest.mark.parametrize("in_order", [True, False])
def test_a_stop_in_order_proves_it_and_a_defect_does_not(tmp_path: Path, in_order: bool) -> None:
    async def run() -> None:
        store_with(tmp_path, 1).close()
        bench = Bench(tmp_path)
        assert bench.store is not None
        bench.store.claim()
        bench.store.load()
        bench.store.trial.begin()
        bench.keeper.loaded()
        await bench.keeper.finish(in_order)
        assert (tmp_path / NAME).exists() is not in_order

    asyncio.run(run())
