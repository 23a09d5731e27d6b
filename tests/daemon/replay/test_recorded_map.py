"""A run that begins with a stored map: its recording holds that map, and the replay gives the same poses."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import pytest

from daemon.cli import parser
from daemon.config.schema import Config, MapConfig
from daemon.maps.image import meta_of, packed
from daemon.maps.initial_state import started
from daemon.maps.store import START, Start, Store
from daemon.replay.recorded_inputs import Given, start_for
from daemon.replay.sources import open_log
from daemon.snapshot import State
from daemon.system import console
from estimator.mapping.map_snapshot import Identity
from estimator.numerics import se2
from estimator.stored_map import image_of
from tests.daemon.replay.test_recorded_run import Bench, assert_the_same, calm, record, replay

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
