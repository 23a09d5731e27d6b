"""SWITCH_MAP under lamps, in the middle of a dump: the daemon goes on in the other map, and the dump repeats it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from daemon.app import Daemon
from daemon.config.schema import MapConfig
from daemon.devices.light_setup import Lights
from daemon.maps.initial_state import started
from daemon.recording import disk_writer, flight_recorder, retention
from daemon.recording.recorder import Recorder
from estimator.cdma.air_interface import PROFILE_A
from estimator.measurements import Command, Order
from hal.clock import run_virtual
from tests.daemon.replay.test_dump import let_write, replayed
from tests.daemon.replay.test_recorded_lights import Recorded
from tests.daemon.scenarios.test_lights import decoded, settings
from tests.daemon.support.light_room import SURVEY
from tests.daemon.support.whole_daemon import during

KEEP_S = 5.0
Ask = Callable[[Callable[[str], None]], None]


class Stored(Recorded):
    """The bench with a folder of maps, and a ring of a few seconds."""

    def make(self) -> Daemon:
        config = replace(settings(self.lidar, True), map=MapConfig(folder=str(self.folder / "maps")))
        self.world.store, self.world.start = started(config.map, self.lights)
        self.recorder = Recorder(self.folder / "rec", config, self.world.clock, self.lights, keep_s=KEEP_S)
        return Daemon(config, self.world, self.recorder)

    async def ended(self, ask: Ask) -> str:
        """The end of an order, while the robot drives on."""
        told: list[str] = []
        ask(told.append)
        while not told:
            await self.drive(0.1)
            let_write(0.01)
        return told[0]


async def on_to_another_map_and_back(bench: Stored) -> None:
    cycle = bench.daemon.cycle
    await bench.until(decoded, 6.0)
    await bench.drive(4.0)
    first = cycle.map_id
    assert await bench.ended(bench.daemon.autosaver.ask) == ""
    cycle.inbox.put_command(Command(bench.loop.time(), Order.RESET))
    await bench.drive(4.0)
    assert cycle.map_id != first
    let_write(0.05)
    assert await bench.ended(lambda told: bench.daemon.maps.ask(first, told)) == ""
    assert cycle.map_id == first
    await bench.drive(1.0)
    await bench.until(decoded, 6.0)
    assert await bench.ended(bench.recorder.box.dump) == ""


def test_a_switch_under_lamps_is_in_the_dump_and_is_repeated(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(disk_writer, "WRITE_S", 0.002)
    monkeypatch.setattr(flight_recorder, "LEAST_S", 2.0)

    async def go() -> Stored:
        bench = Stored(tmp_path, True, Lights(SURVEY, PROFILE_A, 12.5))
        await during(bench.daemon, on_to_another_map_and_back(bench))
        return bench

    bench = run_virtual(go(), start=100.0)
    assert not bench.recorder.failing
    posed = [one for one in bench.snapshots if one.pose is not None]
    steps = np.diff(np.array([one.odom for one in posed]), axis=0)
    assert np.hypot(*steps[:, :2].T).max() < 0.1, "T_odom_base does not jump"
    assert [one.map_id for one in (posed[0], posed[-1])] == [1, 1]
    assert len({one.map_id for one in posed}) == 2
    (dump,) = (tmp_path / "rec").glob(f"{retention.DUMP}*-{retention.ASKED}")
    assert len(list(dump.glob(retention.SWITCHED))) == 1
    assert not (dump / "000000.lumirec").exists(), "it begins in the middle of the run"
    said = replayed(dump, tmp_path / "out")["recorded_run"]
    assert said["differ"] == 0, said
    whole = said["cycles"]
    next(dump.glob(retention.SWITCHED)).unlink()
    said = replayed(dump, tmp_path / "without")["recorded_run"]
    assert "cannot be used" in said["first_difference"]
    assert 0 < said["differ"] <= said["cycles"] == whole, "what cannot be run again was recorded all the same"
