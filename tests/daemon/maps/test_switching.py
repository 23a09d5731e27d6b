"""SWITCH_MAP: the whole daemon goes on in another stored map, found in it by itself, and the replay repeats it."""

import asyncio
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest

from daemon.app import Daemon, Environment
from daemon.cli import parser
from daemon.config.schema import Config, LidarConfig, MapConfig, ModbusConfig
from daemon.maps import switching
from daemon.maps.autosave import About, MapAutosaver
from daemon.maps.container import pack, unpack
from daemon.maps.initial_state import started
from daemon.maps.schema import read
from daemon.maps.store import Store, unjudged
from daemon.maps.switching import Maps, MapSwitch
from daemon.recording.recorder import Recorder
from daemon.runtime.budget import FixedBudget
from daemon.runtime.worker import CycleWorker
from daemon.snapshot import Snapshot, State
from daemon.system import console
from estimator.mapping.map_snapshot import MapImage
from estimator.numerics import se2
from estimator.stored_map import restored
from hal.clock import LoopClock
from hal.fake.lidar.device import FakeHokuyo
from hal.fake.lidar.models import URG_04LX_UG01
from hal.fake.lidar.scan_world import Room
from hal.fake.transport.memory_host import FakeOpener
from tests.daemon.replay.test_recorded_run import assert_the_same
from tests.daemon.scenarios.test_imported_map import DEVICE, MOVED, draw, warm
from tests.daemon.support.map_maker import content

FIRST, SECOND = 0x1000, 0x2000
BAD_SESSION = 77


def folder_of_two(folder: Path, capsys: pytest.CaptureFixture[str]) -> tuple[Path, int, int]:
    """Two maps of one room: as drawn, and (the newest) moved; their IDs."""
    maps = folder / "maps"
    drawing, setting = str(draw(folder)), f"map.folder={maps}"
    ids = []
    for moved in (False, True):
        before = set(maps.glob("*.lumimap"))
        assert parser.main(["map", "import", drawing, "--set", setting]) == console.OK
        (path,) = set(maps.glob("*.lumimap")) - before
        ids.append(int(path.name.split("-")[1], 16))
        if moved:
            points = se2.apply(MOVED, np.array([(0.0, 0.0), (7.0, 3.5)]))
            words = [f"--point=0,0={points[0, 0]},{points[0, 1]}", f"--point=7,3.5={points[1, 0]},{points[1, 1]}"]
            assert parser.main(["map", "align", str(path), *words]) == console.OK
            ids[1] = int(capsys.readouterr().out.split()[-1], 16)
    return maps, ids[0], ids[1]


@dataclass
class Bench:
    """A daemon with a folder of maps, recorded."""

    settings: Config
    recording: Path
    snapshots: list[Snapshot] = field(default_factory=list)
    ended: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        clock = LoopClock(asyncio.get_running_loop(), utc_at_zero=1.7e9)
        opener = FakeOpener(clock)
        opener.plug(DEVICE, FakeHokuyo(URG_04LX_UG01, Room(URG_04LX_UG01)))
        store, start = started(self.settings.map, None)
        recorder = Recorder(self.recording, self.settings, clock, start=start)
        world = Environment(
            clock,
            opener=opener,
            make_worker=CycleWorker,
            make_budget=FixedBudget,
            stopwatch=None,
            warm_up=warm,
            sinks=(self.snapshots.append,),
            store=store,
            start=start,
        )
        self.daemon = Daemon(self.settings, world, recorder)

    async def switch(self, map_id: int) -> str:
        """The end of an order; time goes on until it is told."""
        count = len(self.ended)
        self.daemon.maps.ask(map_id, self.ended.append)
        while len(self.ended) == count:  # noqa: ASYNC110 - virtual time
            await asyncio.sleep(0.02)
        return self.ended[-1]


def error_m(snapshots: list[Snapshot], T: Any) -> float:
    """Largest distance of poses while TRACKING from the truth, in the map that lies at ``T``."""
    known = [one for one in snapshots if one.state is State.TRACKING and one.pose is not None]
    assert len(known) > 30
    truth = Room(URG_04LX_UG01).pose(np.array([one.t_mono for one in known]))
    off = [se2.between(se2.compose(T, place), np.array(one.pose)) for place, one in zip(truth, known, strict=True)]
    return float(np.hypot(*np.array(off)[:, :2].T).max())


@pytest.mark.jit
@pytest.mark.parametrize("localise", [True, pytest.param(False, marks=pytest.mark.slow)])
@pytest.mark.virtual
async def test_the_robot_goes_on_in_another_map_and_the_replay_repeats_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], localise: bool
) -> None:
    maps, first, second = folder_of_two(tmp_path, capsys)
    settings = Config(
        lidar=LidarConfig(device=DEVICE),
        modbus=ModbusConfig(port=0),
        map=MapConfig(folder=str(maps), localise=localise),
    )
    bench = Bench(settings, tmp_path / "rec")
    stop = asyncio.Event()
    running = asyncio.create_task(bench.daemon.run(stop))
    await asyncio.sleep(20.0)
    assert await bench.switch(second) == switching.IN_USE
    assert "no map 00000bad in" in await bench.switch(0xBAD)
    assert await bench.switch(first) == ""
    await asyncio.sleep(35.0)
    stop.set()
    await asyncio.wait_for(running, 10.0)
    posed = [one for one in bench.snapshots if one.pose is not None]
    at = next(number for number, one in enumerate(posed) if one.map_id == first)
    assert {one.map_id for one in posed[:at]} == {second}
    assert {one.map_id for one in posed[at:]} == {first}
    assert error_m(posed[:at], MOVED) < 0.06
    assert error_m(posed[at:], np.zeros(3)) < 0.06
    assert posed[at].state is not State.TRACKING, "the place in the new map has to be found first"
    steps = np.diff(np.array([one.odom for one in posed]), axis=0)
    assert np.hypot(*steps[:, :2].T).max() < 0.1, "T_odom_base does not jump"
    assert posed[-1].jumps > posed[at - 1].jumps
    saved = [one for one in Store(maps).generations() if one.map_id == second]
    assert (len(saved) == 2) is not localise, "the map in use is saved before it is left"
    assert parser.main(["replay", str(tmp_path / "rec"), "--out", str(tmp_path / "out")]) == console.OK
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert_the_same(summary, bench.daemon.cycle.cycles)


@pytest.mark.jit
@pytest.mark.parametrize("generations", [2, 1])
@pytest.mark.virtual
async def test_a_map_that_nothing_can_be_begun_with_is_moved_aside_and_the_one_before_it_is_used(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, generations: int
) -> None:
    maps, first, _ = folder_of_two(tmp_path, capsys)
    for path in maps.glob("*.lumimap"):
        if f"{first:08x}" not in path.name:
            path.unlink()
    (before,) = maps.glob("*.lumimap")
    tables = unpack(before.read_bytes())
    tables["meta"] = msgspec.structs.replace(read(before.read_bytes()).meta, session=BAD_SESSION).packed()
    store = Store(maps)
    bad = store.save(pack(tables), first)
    store.close()
    if generations == 1:
        before.unlink()

    def raising(image: MapImage, *more: Any) -> Any:
        if image.identity.session == BAD_SESSION:
            raise IndexError("index 7 is out of bounds")
        return restored(image, *more)

    monkeypatch.setattr("estimator.restored", raising)
    settings = Config(lidar=LidarConfig(device=DEVICE), modbus=ModbusConfig(port=0), map=MapConfig(folder=str(maps)))
    used: list[int] = []
    broken = bad.with_name(bad.name + ".broken")
    bench = Bench(settings, tmp_path / "rec")

    def there() -> bool:
        ids = {one.map_id for one in bench.snapshots[-1:]}
        return broken.exists() and (generations == 1 or first in ids)

    stop = asyncio.Event()
    running = asyncio.create_task(bench.daemon.run(stop))
    while not there():  # noqa: ASYNC110 - virtual time
        await asyncio.sleep(0.02)  # a thread of real time reads maps, and a loaded machine gives it its time
    used.append(len(bench.snapshots))
    await asyncio.sleep(6.0)
    stop.set()
    await asyncio.wait_for(running, 10.0)
    assert not bad.exists()
    ids = {one.map_id for one in bench.snapshots[used[0] + 5 :] if one.pose is not None}
    if generations == 2:
        assert ids == {first}, "the generation before it is gone on in"
    else:
        assert len(ids) == 1
        assert ids.isdisjoint({first}), "the new map does not take its ID"
    assert parser.main(["replay", str(tmp_path / "rec"), "--out", str(tmp_path / "out")]) == console.OK
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert_the_same(summary, bench.daemon.cycle.cycles)


class Quiet:
    """An autosaver that has nothing to save, or cannot."""

    def __init__(self, reason: str = "", ready: bool = True) -> None:
        self.ready, self.map_id, self._reason = ready, FIRST, reason

    def ask(self, told: Any) -> None:
        told(self._reason)


def asked(store: Store | None, autosaver: Quiet, **maps: Any) -> str:
    """The end of one order, without a daemon."""

    async def go() -> str:
        made = Maps(store, unjudged, maps.pop("make", lambda start: start), **maps)
        switch = MapSwitch(made, autosaver, lambda _, taken: taken())  # type: ignore[arg-type]  # all that is asked of it
        ended: list[str] = []
        switch.ask(SECOND, ended.append)
        if store is not None and autosaver.ready:
            switch.ask(SECOND, ended.append)
            assert ended.pop() == switching.BUSY
        while not ended:  # noqa: ASYNC110 - a thread ends it
            await asyncio.sleep(0.005)
        return ended[0]

    return asyncio.run(go())


def test_what_cannot_be_carried_out_says_why(tmp_path: Path) -> None:
    assert asked(None, Quiet()) == switching.NO_FOLDER
    assert asked(Store(tmp_path), Quiet(ready=False)) == switching.NOT_LOADED
    assert asked(Store(tmp_path), Quiet()).endswith("available maps: none")
    path = tmp_path / f"map-{SECOND:08x}-00000001.lumimap"
    path.write_bytes(b"rubbish")
    assert "map 00002000 cannot be used" in asked(Store(tmp_path, mend=False), Quiet())
    path.write_bytes(content())
    assert ", which differs from its name" in asked(Store(tmp_path, mend=False), Quiet())
    assert asked(Store(tmp_path), Quiet("the disk is full")) == "the map in use cannot be saved: the disk is full"


def test_a_defect_and_a_full_disk_change_nothing_and_are_told(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    def defect(_: object) -> Any:
        raise ZeroDivisionError("a defect")

    def full(_: str, __: bytes) -> None:
        raise OSError(28, "No space left on device")

    from daemon.maps.schema import read

    data = content()
    map_id = read(data).meta.map_id
    (tmp_path / f"map-{map_id:08x}-00000001.lumimap").write_bytes(data)
    autosaver = Quiet()

    async def go(**maps: Any) -> str:
        made = Maps(Store(tmp_path), unjudged, maps.pop("make", lambda start: start), **maps)
        switch = MapSwitch(made, autosaver, lambda _, taken: taken())  # type: ignore[arg-type]  # all that is asked of it
        ended: list[str] = []
        switch.ask(map_id, ended.append)
        while not ended:  # noqa: ASYNC110 - a thread ends it
            await asyncio.sleep(0.005)
        return ended[0]

    assert asyncio.run(go()) == ""
    assert "No space left on device" in asyncio.run(go(keep=full))
    assert asyncio.run(go(make=defect)) == "ZeroDivisionError('a defect')"
    assert "switching the map has failed" in caplog.text


async def test_a_map_that_no_cycle_takes_is_taken_back_and_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lidar and wheels are silent: no record comes, so nothing is stepped. The next order is free to be given."""
    from daemon.maps.schema import read

    monkeypatch.setattr(switching, "TAKEN_S", 0.05)
    data = content()
    map_id = read(data).meta.map_id
    (tmp_path / f"map-{map_id:08x}-00000001.lumimap").write_bytes(data)
    handed: list[switching.Switch | None] = []
    made = Maps(Store(tmp_path), unjudged, lambda start: start)  # type: ignore[arg-type,return-value]  # never used
    switch = MapSwitch(made, Quiet(), lambda one, _: handed.append(one))  # type: ignore[arg-type]  # as above
    ended: list[str] = []
    for count in (1, 2):
        switch.ask(map_id, ended.append)
        while len(ended) < count:  # noqa: ASYNC110 - a thread ends it
            await asyncio.sleep(0.005)
        await asyncio.sleep(0)
    assert ended == [switching.NOTHING_COMES] * 2
    assert [one if one is None else one.map_id for one in handed] == [map_id, None] * 2


async def test_a_start_waits_for_the_lidar_with_the_map_that_it_has_fallen_back_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lidar that is switched on with the robot, or later, gives no scan within the time that an order has."""
    monkeypatch.setattr(switching, "TAKEN_S", 0.01)
    data = content()
    map_id = read(data).meta.map_id
    (tmp_path / f"map-{map_id:08x}-00000001.lumimap").write_bytes(data)
    handed: list[switching.Switch | None] = []

    def put(one: switching.Switch | None, taken: Callable[[], None]) -> None:
        handed.append(one)
        asyncio.get_running_loop().call_later(0.1, taken)

    made = Maps(Store(tmp_path), unjudged, lambda start: start)  # type: ignore[arg-type,return-value]  # never used
    switch = MapSwitch(made, Quiet(), put)  # type: ignore[arg-type]  # all that is asked of it
    ended: list[str] = []
    switch.ask(map_id, ended.append, patient=True)
    while not ended:  # noqa: ASYNC110 - a thread ends it
        await asyncio.sleep(0.005)
    assert ended == [""]
    assert len(handed) == 1


class _Later:
    """A clock at which every save is due."""

    def __init__(self) -> None:
        self.t = 0.0

    def now(self) -> float:
        self.t += 1e6
        return self.t


async def test_the_map_switched_to_is_not_taken_for_one_begun_anew(tmp_path: Path) -> None:
    """Else it would be saved at once, without its name and without what a person has surveyed of it."""
    parts, graph = SimpleNamespace(unproved=None, detached=None), SimpleNamespace(closures=3)
    held = SimpleNamespace(graph=graph, parts=parts, next_key=9, keyframes={1: None})
    state: Any = SimpleNamespace(map=held, light=None)
    used, start = [1], SimpleNamespace()
    saved: list[object] = []
    clock: Any = _Later()
    autosaver = MapAutosaver(Store(tmp_path, mend=False), None, lambda: state, lambda: used[0], About(), clock)
    autosaver._image = saved.append  # type: ignore[method-assign,assignment]  # what would be saved
    autosaver.switched(2, start)  # type: ignore[arg-type]  # only kept
    used[0] = 2
    autosaver._go_on()
    assert saved == []
    assert autosaver._start is start
