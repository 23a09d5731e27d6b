"""A map that ends every start is left out after three, and moved aside once a start without it has lasted."""

import asyncio
import errno
import json
import logging
import os
from pathlib import Path

import pytest

from daemon.app import Daemon, Environment, Pacemaker
from daemon.config.schema import MapConfig
from daemon.maps import autosave, start_trial
from daemon.maps.initial_state import started
from daemon.maps.start_trial import BOOT, MOST, NAME, PROOF_S
from daemon.maps.store import Start
from daemon.runtime import estimator_runner
from daemon.runtime.warmup import CannotLoad
from hal.clock import LoopClock, run_virtual
from hal.fake.transport.memory_host import FakeOpener
from tests.daemon.maps.autosave_bench import Bench
from tests.daemon.maps.test_store import name, names, store_with
from tests.daemon.scenarios.test_daemon import SETTINGS
from tests.daemon.support.map_maker import Shape, content
from tests.daemon.support.odd_files import KINDS, planted


def begin(folder: Path, lasts: bool = False, ends: bool = False) -> Start | None:
    """One start; it dies, or lasts, or is ended by somebody."""
    store, start = started(MapConfig(folder=str(folder)), None)
    assert store is not None
    store.trial.begin()
    if lasts:
        store.lasted()
    if ends:
        store.trial.ended()
    store.close()
    return start


def seeds(folder: Path, count: int) -> list[int | None]:
    """Which of two generations so many starts that die have begun with, None: with no map."""
    known = {content(seed=seed): seed for seed in (1, 2, 3)}
    begun = [begin(folder) for _ in range(count)]
    return [None if one is None else known[one.content] for one in begun]


def test_starts_that_die_go_through_the_generations_and_no_map_in_turn(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Of a good map nothing is lost, whatever ends them."""
    store_with(tmp_path, 1, 2).close()
    assert seeds(tmp_path, MOST) == [2] * MOST
    assert "refused" not in caplog.text
    assert seeds(tmp_path, MOST) == [1] * MOST
    said = [record.getMessage() for record in caplog.records if record.levelno == logging.ERROR]
    assert len(said) == MOST, "each start says what it leaves out"
    assert all(name(2) in words and f"{MOST} starts in a row" in words for words in said)
    assert seeds(tmp_path, MOST) == [None] * MOST
    assert "tries the map again" not in caplog.text
    assert seeds(tmp_path, 3 * MOST + 1) == [2] * MOST + [1] * MOST + [None] * MOST + [2]
    assert sum("tries the map again" in words for words in caplog.messages) == 2
    assert names(tmp_path) == [name(1), name(2)]


@pytest.mark.parametrize(("dying", "aside"), [(MOST, [2]), (2 * MOST, [1, 2])])
def test_once_a_start_without_it_has_lasted_it_is_moved_aside(tmp_path: Path, dying: int, aside: list[int]) -> None:
    store_with(tmp_path, 1, 2).close()
    seeds(tmp_path, dying)
    begin(tmp_path, lasts=True)
    assert names(tmp_path) == [name(k, more=".broken" if k in aside else "") for k in (1, 2)]
    assert seeds(tmp_path, 2) == [None if 1 in aside else 1] * 2


def test_a_start_that_lasts_makes_good_for_those_before(tmp_path: Path) -> None:
    store_with(tmp_path, 2).close()
    for number in range(3 * MOST):
        assert begin(tmp_path, lasts=number % MOST == MOST - 1) is not None
    assert names(tmp_path) == [name(1)]


def test_a_start_that_somebody_ends_says_nothing(tmp_path: Path) -> None:
    store_with(tmp_path, 1, 2).close()
    seeds(tmp_path, MOST)
    for _ in range(3 * MOST):
        start = begin(tmp_path, ends=True)
        assert start is not None
        assert start.content == content(seed=1)
    assert seeds(tmp_path, MOST + 1) == [1] * MOST + [None]
    assert names(tmp_path) == [name(1), name(2)]


def test_starts_with_one_map_do_not_count_for_another(tmp_path: Path) -> None:
    store = store_with(tmp_path, 1)
    store.close()
    assert seeds(tmp_path, MOST - 1) == [1] * (MOST - 1)
    store_with(tmp_path, 2).close()
    assert seeds(tmp_path, MOST + 1) == [2] * MOST + [1]


def test_a_count_that_cannot_be_written_leaves_nothing_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store_with(tmp_path, 1, 2).close()
    seeds(tmp_path, MOST)
    before = (tmp_path / NAME).read_bytes()

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    assert seeds(tmp_path, 2) == [2, 2]
    assert (tmp_path / NAME).read_bytes() == before
    assert names(tmp_path) == [name(1), name(2)]


def test_another_map_does_not_stand_in_for_one_that_is_left_out(tmp_path: Path) -> None:
    """What a person has begun anew does not come back by itself, nor does what ends every start take it with it."""
    store = store_with(tmp_path, 1)
    store.save(content(Shape(map_id=0x77)), 0x77)
    store.close()
    begun = [begin(tmp_path) for _ in range(2 * MOST + 1)]
    found = [None if one is None else one.stored.meta.map_id for one in begun]
    assert found == [0x77] * MOST + [None] * MOST + [0x77]
    assert len(names(tmp_path)) == 2


def test_a_robot_without_any_map_counts_nothing(tmp_path: Path) -> None:
    for _ in range(2 * MOST):
        assert begin(tmp_path) is None
    assert not (tmp_path / NAME).exists()


@pytest.mark.jit
def test_a_daemon_that_dies_at_once_goes_through_them_and_leaves_no_map(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The whole process but for the wires, whose cycle a defect ends with or without a map."""
    store_with(tmp_path, 1).close()

    def go() -> bool:
        store, start = started(MapConfig(folder=str(tmp_path)), None)

        async def run() -> None:
            clock = LoopClock(asyncio.get_running_loop(), utc_at_zero=1.7e9)
            opener = FakeOpener(clock)
            await Daemon(SETTINGS, Environment(clock, opener=opener, store=store, start=start)).run(asyncio.Event())

        with pytest.raises(ZeroDivisionError):
            run_virtual(run())
        return start is not None

    async def defect(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr(Pacemaker, "run", defect)
    assert [go() for _ in range(3 * MOST)] == [True] * MOST + [False] * MOST + [True] * MOST
    assert names(tmp_path) == [name(1)]


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
        world = Environment(clock, opener=FakeOpener(clock), warm_up=warm_up, store=store, start=start)
        await Daemon(SETTINGS, world).run(asyncio.Event())

    monkeypatch.setattr(estimator_runner, "new_state", ended)
    with pytest.raises(CannotLoad):
        run_virtual(go())
    assert (tmp_path / NAME).exists() is counts


def test_another_run_of_the_computer_counts_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A battery that fails says nothing of the map."""
    folder, boot = tmp_path / "maps", tmp_path / "boot_id"
    monkeypatch.setattr(start_trial, "BOOT", boot)
    store_with(folder, 1).close()
    for number in range(2 * MOST):
        boot.write_text(f"boot-{number}\n")
        assert begin(folder) is not None
    boot.unlink()
    for _ in range(MOST):
        assert begin(folder) is not None
    assert begin(folder) is None


@pytest.mark.parametrize(
    "held",
    [
        *(b"", b"\xff", b"rubbish", b"[]", b"{}", b'{"boot": "-", "of": 1, "count": "x", "out": []}'),
        *(b"[" * 100_000, b'{"out": ' + b"[" * 100_000, b'{"a": ' * 100_000, b" " * (1 << 20) + b"{}"),
        *(b'{"boot": "BOOT", "count": %s}' % number for number in (b"1e999", b"-1", b"9" * 5000, b"NaN", b"null")),
        *(b'{"boot": "BOOT", "out": ["%s"]}' % path for path in (b"", b".", b"../x.lumimap", b"a/b.lumimap", b"lock")),
        b'{"boot": "BOOT", "out": [["a"], null]}',
    ],
    ids=lambda held: repr(held[:40]),
)
def test_a_count_that_cannot_be_read_is_none(tmp_path: Path, held: bytes, caplog: pytest.LogCaptureFixture) -> None:
    store_with(tmp_path, 1).close()
    (tmp_path / NAME).write_bytes(held.replace(b"BOOT", BOOT.read_bytes().strip()))
    before = names(tmp_path)
    assert begin(tmp_path, lasts=True) is not None
    assert names(tmp_path) == before
    assert caplog.text.count(f"{tmp_path / NAME} ") == (held != b"{}")


@pytest.mark.parametrize("kind", KINDS)
def test_a_count_that_is_no_regular_file_is_none(tmp_path: Path, kind: str, caplog: pytest.LogCaptureFixture) -> None:
    store_with(tmp_path, 1).close()
    planted(tmp_path / NAME, kind)
    assert begin(tmp_path) is not None
    assert caplog.text.count(f"{tmp_path / NAME} cannot be read") == 1


def test_a_map_whose_name_is_no_text_is_left_out_like_any_other(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Linux takes any bytes for a name."""
    caplog.set_level(
        logging.CRITICAL, "daemon.maps.store"
    )  # lines with the name: no report of a worker may contain them
    (tmp_path / os.fsdecode(b"\xff\xfe.lumimap")).write_bytes(content(seed=1))
    for _ in range(MOST):
        assert begin(tmp_path) is not None
    assert begin(tmp_path) is None


def test_a_folder_that_cannot_be_written_counts_nothing(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    (tmp_path / NAME).mkdir()
    for _ in range(2 * MOST):
        assert begin(tmp_path, lasts=True) is not None
        assert begin(tmp_path) is not None


def test_who_only_looks_or_uses_a_map_as_it_is_counts_nothing(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    for _ in range(2 * MOST):
        started(MapConfig(folder=str(tmp_path)), None, mend=False)
        started(MapConfig(folder=str(tmp_path), localise=True), None)
    assert names(tmp_path) == [name(1)]
    assert not (tmp_path / NAME).exists()


async def test_a_run_is_proved_when_it_has_lasted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(autosave, "BEAT_S", 0.01)
    store_with(tmp_path, 1).close()
    bench = Bench(tmp_path)
    assert bench.store is not None
    bench.store.claim()
    bench.store.load()
    bench.store.trial.begin()
    bench.autosaver.loaded()
    beats = asyncio.create_task(bench.autosaver.run())
    bench.clock.t += PROOF_S - 0.1
    await asyncio.sleep(0.1)
    assert (tmp_path / NAME).exists()
    bench.clock.t += 0.1
    async with asyncio.timeout(20.0):
        while (tmp_path / NAME).exists():  # noqa: ASYNC110  # nothing tells of it
            await asyncio.sleep(0.01)
    beats.cancel()


@pytest.mark.parametrize("in_order", [True, False])
async def test_a_stop_in_order_does_not_count_and_a_defect_does_and_saves_nothing(
    tmp_path: Path, in_order: bool
) -> None:
    store_with(tmp_path, 1).close()
    bench = Bench(tmp_path)
    assert bench.store is not None
    bench.store.claim()
    bench.store.load()
    bench.store.trial.begin()
    bench.autosaver.loaded()
    bench.drive()
    await bench.autosaver.finish(in_order)
    assert json.loads((tmp_path / NAME).read_bytes())["count"] == (0 if in_order else 1)
    assert (len(names(tmp_path)) > 1) is in_order
