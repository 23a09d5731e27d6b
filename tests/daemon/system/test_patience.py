"""A disk that does not answer costs what is on it, and is named."""

import logging
import threading
import time
from pathlib import Path

import pytest

from daemon.config.schema import MapConfig
from daemon.maps import initial_state, last_pose
from daemon.maps.initial_state import NoMap, started_in_time
from daemon.maps.store import Store
from daemon.system import patience
from daemon.system.patience import reported, within
from tests.daemon.maps.test_store import MAP, names, store_with
from tests.daemon.support.map_maker import content


def test_what_is_done_in_time_is_passed_on() -> None:
    assert within(5.0, lambda: 7) == 7
    with pytest.raises(ZeroDivisionError):
        within(5.0, lambda: 1 / 0)


def test_what_comes_late_is_handed_to_whoever_tidies_up() -> None:
    go_on, late = threading.Event(), threading.Event()
    with pytest.raises(TimeoutError, match="does not answer"):
        within(0.02, lambda: go_on.wait(10.0), lambda result: late.set())
    assert not late.is_set()
    go_on.set()
    assert late.wait(10.0)


def test_a_wait_is_reported(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    told: list[str] = []
    monkeypatch.setattr(patience, "REPORT_S", 0.02)
    monkeypatch.setattr(patience, "notify", lambda *words: told.extend(words))
    with reported("the map"):
        while "waiting for the map" not in caplog.text:
            time.sleep(0.01)
    assert f"EXTEND_TIMEOUT_USEC={patience.EXTEND_US}" in told


@pytest.fixture
def hanging(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A folder with a map, on a disk that answers once the event is set."""
    store_with(tmp_path, 1).close()
    answers, load = threading.Event(), Store.load

    def waits(store: Store, *judge: object) -> object:
        assert answers.wait(30.0)
        return load(store, *judge)  # type: ignore[arg-type]

    monkeypatch.setattr(Store, "load", waits)
    monkeypatch.setattr(initial_state, "MAPS_S", 0.1)
    return answers


def test_a_start_goes_on_without_maps_that_do_not_come(
    tmp_path: Path, hanging: threading.Event, caplog: pytest.LogCaptureFixture
) -> None:
    store, start = started_in_time(MapConfig(folder=str(tmp_path)), None)
    assert store is not None
    assert start is None
    assert store.refused
    assert f"maps in {tmp_path} cannot be read: the disk does not answer within 0 s" in caplog.text
    before = names(tmp_path)
    hanging.set()
    until = time.monotonic() + 10.0
    store.claim()
    while store.trouble and time.monotonic() < until:  # the late start lets go of the folder
        time.sleep(0.02)
        store.claim()
    store.save(content(seed=2), MAP + 1)
    assert set(before) < set(names(tmp_path))


def test_a_map_that_is_required_and_does_not_come_is_said(tmp_path: Path, hanging: threading.Event) -> None:
    with pytest.raises(NoMap, match="does not answer"):
        started_in_time(MapConfig(folder=str(tmp_path), localise=True), None)
    hanging.set()


def test_a_last_pose_that_does_not_come_is_done_without(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    answers = threading.Event()
    monkeypatch.setattr(last_pose, "READ_S", 0.05)
    monkeypatch.setattr(last_pose, "read_regular", lambda path, most: answers.wait(10.0) and b"")
    with caplog.at_level(logging.WARNING):
        assert last_pose.read(tmp_path / "last-pose") is None
    assert "the disk does not answer" in caplog.text
    answers.set()
