"""Recorded runs with a map, with a change of maps, and of a real process: the replay repeats them."""

import json
import logging
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from daemon.app import Daemon
from daemon.cli import parser
from daemon.config.schema import Config, MapConfig
from daemon.devices.light_setup import Lights
from daemon.diagnosis.recorded_spans import spans
from daemon.maps.image import meta_of, packed
from daemon.maps.initial_state import started
from daemon.maps.store import START, Start, Store
from daemon.recording import disk_writer, flight_recorder, retention
from daemon.recording.recorder import Recorder
from daemon.replay.recorded_inputs import Given, start_for
from daemon.replay.sources import open_log
from daemon.snapshot import State
from daemon.system import console
from estimator.cdma.air_interface import PROFILE_A
from estimator.mapping.map_snapshot import Identity
from estimator.measurements import Command, Order
from estimator.numerics import se2
from estimator.stored_map import image_of
from hal.clock import run_virtual
from tests.daemon.processes.test_process import ROOT, fake_lidar, running
from tests.daemon.replay.test_dump import let_write, replayed
from tests.daemon.replay.test_recorded_lights import Recorded
from tests.daemon.replay.test_recorded_run import Bench, assert_the_same, calm, record, replay
from tests.daemon.scenarios.test_lights import decoded, settings
from tests.daemon.support.light_room import SURVEY
from tests.daemon.support.whole_daemon import during
from tests.taps.documented import documented

MAP = 0xABC


def kept(bench: Bench, folder: Path) -> Start:
    """What a run has mapped, saved and loaded again."""
    state = bench.daemon._estimator.state
    assert state is not None
    image = image_of(state, Identity(MAP))
    Store(folder).save(packed(image, meta_of(image, 0.0, "robot", "")), MAP)
    start = started(MapConfig(folder=str(folder)), None)[1]
    assert start is not None
    return start


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Bench, Start]:
    folder = tmp_path_factory.mktemp("run")
    start = kept(record(folder / "first", calm), folder / "maps")
    return folder, record(folder / "second", calm, start=start), start


def test_a_run_begins_with_the_map_and_does_not_pretend_to_know_its_place(run: tuple[Path, Bench, Start]) -> None:
    _, bench, start = run
    assert len(start.stored.tables["submap.key"]) >= 1
    assert {snapshot.map_id for snapshot in bench.snapshots} == {MAP}
    posed = [snapshot for snapshot in bench.snapshots if snapshot.pose is not None]
    last = start.stored.tables["pose"][0]
    assert np.abs(se2.between(last, np.array(posed[0].pose)))[:2].max() < 0.3, "it is guessed to be where it was"
    early = [snapshot.state for snapshot in posed if snapshot.t_mono < posed[0].t_mono + 1.0]
    assert State.TRACKING not in early


def test_the_replay_repeats_it_to_the_last_bit(run: tuple[Path, Bench, Start], tmp_path: Path) -> None:
    folder, bench, start = run
    (recording,) = (folder / "second").iterdir()
    assert (recording / START).read_bytes() == start.content
    summary = replay(folder / "second", tmp_path / "out")
    assert_the_same(summary, bench.daemon.cycle.cycles)


def test_a_replay_without_the_map_is_refused(
    run: tuple[Path, Bench, Start], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (recording,) = (run[0] / "second").iterdir()
    good = (recording / START).read_bytes()
    for content, why in ((good[:-1], "is not the map from the start of the recorded run"), (None, "No such file")):
        (recording / START).unlink()
        if content is not None:
            (recording / START).write_bytes(content)
        assert parser.main(["replay", str(run[0] / "second"), "--out", str(tmp_path / "out")]) == console.FAILED
        said = capsys.readouterr().err
        assert why in said
        assert "--set map.folder=DIR" in said
    (recording / START).write_bytes(good)


def test_a_replay_may_begin_with_a_map_that_a_person_names(
    run: tuple[Path, Bench, Start], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    words = ["replay", str(run[0] / "first"), "--out", str(tmp_path / "out"), "--set", f"map.folder={run[0] / 'maps'}"]
    with caplog.at_level(logging.INFO):
        assert parser.main(words) == console.OK
    assert "map 00000abc of" in caplog.text
    assert len(list((run[0] / "maps").glob("*.lumimap"))) == 1, "a replay writes no map there"


def test_a_named_folder_without_a_map_is_refused_one_of_a_configuration_is_noted(
    run: tuple[Path, Bench, Start], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty"
    empty.mkdir()
    words = ["replay", str(run[0] / "first"), "--out", str(tmp_path / "out")]
    assert parser.main([*words, "--set", f"map.folder={empty}"]) == console.FAILED
    said = capsys.readouterr().err
    assert f"{empty} holds no usable map (name another folder" in said
    assert "--set map.folder=none" in said
    assert parser.main([*words, "--set", "map.folder=none"]) == console.OK
    assert "holds no usable map" not in capsys.readouterr().err

    source = open_log(run[0] / "first")
    assert start_for(source, Config(map=MapConfig(folder=str(empty))), None, Given(keys=("map.localise",))) is None
    assert source.report.notes == [f"{empty} holds no usable map; the replay runs without one"]


def test_the_map_that_a_replay_writes_is_one_to_begin_with(
    run: tuple[Path, Bench, Start], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    replay(run[0] / "first", tmp_path / "out")
    assert parser.main(["map", "verify", str(tmp_path / "out" / "map.lumimap")]) == console.OK
    assert "valid, map" in capsys.readouterr().out
    assert started(MapConfig(folder=str(tmp_path / "out")), None)[1] is not None


def test_another_method_begins_with_an_empty_map(
    run: tuple[Path, Bench, Start], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = replay(run[0] / "second", tmp_path / "out", "--method", "pic")
    assert summary["method"] == "pic"
    assert summary["recorded_run"] is None
    assert "method pic begins with an empty map" in capsys.readouterr().err


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


@pytest.mark.realtime
@pytest.mark.system
def test_a_killed_run_is_repeated_to_the_last_bit(tmp_path: Path) -> None:
    """Measured budgets, a worker thread, a real tty: nothing of that may matter to the replay."""
    link, folder = tmp_path / "lidar", tmp_path / "recordings"
    with fake_lidar(link), running(link, "--record", str(folder)) as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        time.sleep(3.0)
        daemon.process.kill()
        daemon.process.wait(10.0)
    assert parser.main(["replay", str(folder), "--out", str(tmp_path / "out")]) == console.OK
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    compared = summary["recorded_run"]
    assert compared["differ"] == 0, compared["first_difference"]
    assert compared["cycles"] > 3.0 / 0.025 / 4
    assert summary["config"]["lidar"]["device"] == str(link)


@pytest.mark.realtime
@pytest.mark.system
def test_the_ring_of_a_killed_run_is_a_dump_after_the_next_start_and_is_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half a second of the run is lost at most."""
    link, folder = tmp_path / "lidar", tmp_path / "ring"
    with fake_lidar(link), running(link, "--record", str(folder), "--last", "1") as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        time.sleep(33.0)  # past the first state
        killed = time.time()
        daemon.process.kill()
        daemon.process.wait(10.0)
    with fake_lidar(link), running(link, "--record", str(folder), "--last", "1") as daemon:
        daemon.until(30.0, "state", State.TRACKING)
    (dump,) = folder.glob("dump-*-died")
    assert spans(dump)[0].end > killed - 0.5 - 0.1
    state = sorted(dump.glob("*.lumistate"))[0]
    for segment in dump.glob("*.lumirec"):
        if segment.stem < state.stem:
            segment.unlink()
    assert parser.main(["replay", str(dump), "--out", str(tmp_path / "out")]) == console.OK
    compared = json.loads((tmp_path / "out" / "summary.json").read_text())["recorded_run"]
    assert compared["differ"] == 0, compared["first_difference"]
    assert compared["cycles"] > 20


@pytest.mark.realtime
@pytest.mark.system
def test_a_dump_is_asked_for_as_the_page_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The line of docs/replay.md, to the socket of this daemon, without `modbus.write`."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (ask,) = (line.split()[1:] for line in documented(ROOT / "docs" / "replay.md") if line.startswith("lumiloop dump"))
    link, folder = tmp_path / "lidar", tmp_path / "flight"
    with fake_lidar(link), running(link, "--record", str(folder), "--last", "1") as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        subprocess.run([sys.executable, "-m", "daemon", *ask], check=True, capture_output=True, timeout=60.0)
        assert len(list(folder.glob("dump-*-asked"))) == 1


@pytest.mark.realtime
def test_a_folder_that_cannot_be_written_costs_the_recording_and_no_more(tmp_path: Path) -> None:
    place = tmp_path / "file"
    place.write_text("")
    with fake_lidar(tmp_path / "lidar"), running(tmp_path / "lidar", "--record", str(place)) as daemon:
        daemon.until(30.0, "state", State.TRACKING)
        daemon.until(10.0, "fault", 402)
        code, said, _ = daemon.stop()
    assert code == console.OK
    assert "has stopped: Not a directory" in said
