"""The folder of maps: which is loaded, which are kept, and what becomes of those that cannot be used."""

import logging
from dataclasses import replace
from pathlib import Path

import pytest

from daemon.config.schema import MapConfig
from daemon.devices.light_setup import Lights
from daemon.maps.container import Damaged, Foreign
from daemon.maps.generations import NEWEST, OTHERS
from daemon.maps.initial_state import NoMap, new_state, recorded_start, started
from daemon.maps.schema import digest_of
from daemon.maps.store import Store
from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter.survey import Survey
from tests.daemon.support.map_maker import LAMPS, SURVEY, Shape, content

MAP = 0x1234


def store_with(folder: Path, *seeds: int) -> Store:
    store = Store(folder)
    for seed in seeds:
        store.save(content(seed=seed), MAP)
    return store


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir() if path.name not in ("lock", "starts"))


def name(number: int, map_id: int = MAP, more: str = "") -> str:
    return f"map-{map_id:08x}-{number:08d}.lumimap{more}"


def test_the_newest_map_is_loaded(tmp_path: Path) -> None:
    store_with(tmp_path, 1, 2).close()
    start = Store(tmp_path).load()
    assert start is not None
    assert start.content == content(seed=2)
    assert start.stored.meta.map_id == MAP


def test_nothing_is_made_where_nothing_is_saved(tmp_path: Path) -> None:
    store = Store(tmp_path / "a" / "b")
    assert store.load() is None
    assert not store.refused
    assert names(tmp_path) == []


def test_the_newest_two_are_kept_and_the_one_that_the_run_began_with(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    store = Store(tmp_path)
    store.load()
    for seed in range(2, 7):
        store.save(content(seed=seed), MAP)
    assert names(tmp_path) == [name(1), name(5), name(6)]
    store.close()
    later = Store(tmp_path)
    later.load()
    later.save(content(seed=7), MAP)
    assert names(tmp_path) == [name(6), name(7)]
    assert NEWEST == 2


def test_of_other_maps_the_newest_generation_is_kept_of_the_seven_latest(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = Store(tmp_path)
    for map_id in range(1, 10):
        store.save(content(Shape(map_id=map_id)), map_id)
        store.save(content(Shape(map_id=map_id), 1), map_id)
    kept = names(tmp_path)
    assert kept == sorted([name(2 * k, k) for k in range(2, 10)] + [name(17, 9)])
    assert "maps of other areas are newer" in caplog.text


def test_a_good_generation_of_another_map_stays_where_the_newer_one_is_broken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store_with(tmp_path, 1, 2, 3).close()
    (tmp_path / name(1)).write_bytes(content(seed=1))
    broken = tmp_path / name(3)
    broken.write_bytes(broken.read_bytes()[:900])
    store = Store(tmp_path)
    with caplog.at_level(logging.INFO):
        for _ in range(2):
            store.save(content(Shape(map_id=5)), 5)
    assert names(tmp_path) == [name(4, 5), name(5, 5), name(2), name(3)]
    assert f"{tmp_path / name(1)} is deleted: newer files of this map are kept" in caplog.text
    assert caplog.text.count(f"{broken} cannot be used") == 1


def test_maps_that_cannot_be_read_do_not_push_out_those_that_can(tmp_path: Path) -> None:
    store = store_with(tmp_path, 1)
    for map_id in range(1, OTHERS + 2):
        store.save(content(Shape(map_id=map_id)), map_id)
        (tmp_path / name(1 + map_id, map_id)).write_bytes(b"")
    assert name(1) in names(tmp_path)


@pytest.mark.parametrize("spoil", [lambda good: good[:900], lambda good: b"x" + good[1:], lambda good: b""])
def test_a_broken_map_is_kept_aside_and_the_generation_before_it_loaded(
    tmp_path: Path, spoil: object, caplog: pytest.LogCaptureFixture
) -> None:
    assert callable(spoil)
    store_with(tmp_path, 1, 2).close()
    broken = tmp_path / name(2)
    broken.write_bytes(spoil(broken.read_bytes()))
    store = Store(tmp_path)
    start = store.load()
    assert start is not None
    assert start.content == content(seed=1)
    assert store.refused
    assert names(tmp_path) == [name(1), name(2, more=".broken")]
    for said in (
        f"{broken}.broken is refused",
        f"{tmp_path / name(1)} is used, the newest valid generation of this map",
    ):
        assert said in caplog.text
    store.save(content(seed=3), MAP)
    assert names(tmp_path) == [name(1), name(2, more=".broken"), name(3)]


def test_a_map_of_a_newer_version_is_left_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    store_with(tmp_path, 1, 2).close()
    newer = tmp_path / name(2)
    newer.write_bytes(newer.read_bytes()[:8] + b"\x02\x00" + newer.read_bytes()[10:])
    store = Store(tmp_path)
    start = store.load()
    assert start is not None
    assert start.content == content(seed=1)
    assert names(tmp_path) == [name(1), name(2)]
    assert "has version 2; this software reads versions up to 1; install that version" in caplog.text


def test_a_map_under_another_maps_name_is_refused(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tmp_path.joinpath(name(1, 0x9999)).write_bytes(content())
    assert Store(tmp_path).load() is None
    assert "it contains map 00001234, which differs from its name" in caplog.text
    assert names(tmp_path) == [name(1, 0x9999, ".broken")]


def test_what_was_forgotten_does_not_come_back_where_the_new_map_is_broken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    store = store_with(tmp_path, 1)
    store.save(content(Shape(map_id=5)), 5)
    store.close()
    tmp_path.joinpath(name(2, 5)).write_bytes(b"")
    assert started(MapConfig(folder=str(tmp_path)), None)[1] is None
    assert "the daemon begins a new" in caplog.text
    assert "is used" not in caplog.text


def test_who_only_looks_says_nothing_of_what_is_begun(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    tmp_path.joinpath(name(1)).write_bytes(content()[:900])
    assert Store(tmp_path, mend=False).load() is None
    assert "the file ends" in caplog.text or "truncated" in caplog.text
    assert "begun" not in caplog.text
    assert "is used" not in caplog.text


def test_each_building_has_its_own_map(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    other = tuple(replace(lamp, x=lamp.x + 40.0) for lamp in LAMPS)
    store = Store(tmp_path)
    for map_id, lamps in ((1, LAMPS), (2, other)):
        shape = Shape(lit=True, map_id=map_id, survey=digest_of(Survey(lamps)), lamps=lamps)
        store.save(content(shape), map_id)
    store.close()
    for map_id, lamps in ((1, LAMPS), (2, other)):
        _, start = started(MapConfig(folder=str(tmp_path)), Lights(Survey(lamps), PROFILE_A))
        assert start is not None
        assert start.stored.meta.map_id == map_id
    caplog.clear()
    nowhere = Survey(tuple(replace(lamp, y=lamp.y - 50.0) for lamp in LAMPS))
    store, start = started(MapConfig(folder=str(tmp_path)), Lights(nowhere, PROFILE_A))
    assert start is None
    assert store is not None
    assert store.refused
    assert len(names(tmp_path)) == 2
    assert "name the survey of this map in `lights.survey`" in caplog.text


def test_a_survey_that_has_changed_is_said_and_the_map_used(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Store(tmp_path).save(content(Shape(lit=True, survey=digest_of(SURVEY))), MAP)
    survey = Survey((replace(LAMPS[0], y=5.0), *LAMPS[1:]))
    _, start = started(MapConfig(folder=str(tmp_path)), Lights(survey, PROFILE_A))
    assert start is not None
    assert start.changed == {1}
    assert f"{tmp_path / name(1)}: the survey has changed since, lamps moved: 1" in caplog.text


def test_a_torn_map_is_kept_aside_whole(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Store(tmp_path).save(content(Shape(submaps=8, loose=2)), MAP)
    start = Store(tmp_path).load()
    assert start is not None
    assert len(start.stored.tables["submap.key"]) == 6
    assert names(tmp_path) == [name(1), name(1, more=".torn")]
    assert "2 submaps have no edge to the others and are not used" in caplog.text


def test_a_map_that_is_to_be_used_as_it_is_has_to_be_there(tmp_path: Path) -> None:
    config = MapConfig(folder=str(tmp_path), localise=True)
    with pytest.raises(NoMap, match=f"{tmp_path}: the folder has no usable map") as caught:
        started(config, None)
    assert "lumiloop map import" in str(caught.value)
    store_with(tmp_path, 1).close()
    assert started(config, None)[1] is not None
    assert started(MapConfig(folder="none"), None) == (None, None)


def test_a_replay_moves_nothing_aside(tmp_path: Path) -> None:
    tmp_path.joinpath(name(1)).write_bytes(b"x")
    assert started(MapConfig(folder=str(tmp_path)), None, mend=False)[1] is None
    assert names(tmp_path) == [name(1)]


def test_a_recorded_map_must_be_the_one_that_the_run_began_with(tmp_path: Path) -> None:
    path = tmp_path / "start.lumimap"
    path.write_bytes(content())
    with pytest.raises(Damaged, match=r"start\.lumimap is not the map"):
        recorded_start(path, "0" * 64, None)


def test_a_map_that_somebody_has_put_there_is_loaded_where_there_is_no_other_and_never_removed(tmp_path: Path) -> None:
    given = tmp_path / "second floor.lumimap"
    given.write_bytes(content(seed=3))
    store = Store(tmp_path)
    start = store.load()
    assert start is not None
    assert start.content == content(seed=3)
    for seed in range(4, 8):
        store.save(content(seed=seed), MAP)
    assert names(tmp_path) == [name(3), name(4), given.name]
    store.close()
    start = Store(tmp_path).load()
    assert start is not None
    assert start.content == content(seed=7)


def test_a_map_that_somebody_has_put_there_is_found_by_its_identity(tmp_path: Path) -> None:
    (tmp_path / "second floor.lumimap").write_bytes(content())
    (tmp_path / "no map.lumimap").write_bytes(b"nothing")
    store = Store(tmp_path)
    assert {store.identity(one) for one in store.generations()} == {MAP, -1}
    assert store.load_map(MAP).stored.meta.map_id == MAP
    with pytest.raises(Foreign, match="no map 00000077"):
        store.load_map(0x77)


def test_what_is_no_map_among_what_somebody_has_put_there_hides_no_other(tmp_path: Path) -> None:
    tmp_path.joinpath("a.lumimap").write_bytes(b"no map")
    tmp_path.joinpath("z.lumimap").write_bytes(content(seed=3))
    store = Store(tmp_path)
    start = store.load()
    assert start is not None
    assert start.content == content(seed=3)
    assert store.damaged, "and it is said"


def test_maps_that_are_not_looked_at_because_the_latest_is_broken_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    tmp_path.joinpath(name(9, 5)).write_bytes(b"no map")
    tmp_path.joinpath("good.lumimap").write_bytes(content(seed=3))
    assert Store(tmp_path).load() is None
    assert "files of other maps are not used: good.lumimap; to use one, move the others away" in caplog.text


def test_a_map_of_another_building_was_looked_at(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    elsewhere = tuple(replace(lamp, x=lamp.x + 40.0) for lamp in LAMPS)
    shape = Shape(lit=True, map_id=7, survey=digest_of(Survey(elsewhere)), lamps=elsewhere)
    tmp_path.joinpath(name(9, 7)).write_bytes(content(shape))
    tmp_path.joinpath(name(5, 5)).write_bytes(b"no map")
    tmp_path.joinpath("good.lumimap").write_bytes(content(seed=3))
    assert started(MapConfig(folder=str(tmp_path)), Lights(SURVEY, PROFILE_A))[1] is None
    assert "files of other maps are not used: good.lumimap;" in caplog.text


def test_a_map_to_be_used_as_it_is_is_known_as_such_to_the_estimator(tmp_path: Path) -> None:
    store_with(tmp_path, 1).close()
    for localise in (True, False):
        _, start = started(MapConfig(folder=str(tmp_path), localise=localise), None)
        assert start is not None
        state = new_state(None, start=start)
        assert state.settings.localise is localise
        assert len(state.map.graph.submaps) == 4
