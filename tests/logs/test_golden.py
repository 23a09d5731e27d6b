"""Every log gives the trajectory that was blessed."""

from __future__ import annotations

import numpy as np
import pytest

from daemon.results import Trajectory
from tests.logs import golden
from tests.logs.catalog import ENTRIES, Entry, ledger_of
from tests.logs.conftest import Replayed

REMEDY = "look at the change; if it is meant: python -m tests.logs.bless --reason TEXT"


def cases() -> list[object]:
    return [pytest.param(entry, id=entry.name, marks=[pytest.mark.slow] if entry.heavy else []) for entry in ENTRIES]


@pytest.mark.parametrize("entry", cases())
def test_the_trajectory_is_the_blessed_one(entry: Entry, outcome_of: Replayed) -> None:
    trajectory = ledger_of(outcome_of(entry.name)).final()
    blessed = golden.load(entry.name)
    assert blessed.facts["poses"] == str(len(trajectory.stamps))
    off = golden.largest_difference(blessed, trajectory, entry.every)
    if blessed.facts["environment"] == golden.environment():
        assert off <= golden.TIGHT_M, f"{entry.name} moved by {off:.6f} m since {blessed.facts['reason']!r}; {REMEDY}"
        assert blessed.facts["digest"] == golden.digest(trajectory), f"{entry.name} differs between; {REMEDY}"
    else:
        off = golden.largest_difference(blessed, trajectory, entry.every, motion=True)
        assert off <= golden.LOOSE_M, f"{entry.name} moves otherwise, by {off:.3f} m, than where it was blessed"


@pytest.mark.parametrize("entry", ENTRIES, ids=lambda entry: entry.name)
def test_a_golden_file_says_what_it_is(entry: Entry) -> None:
    facts = golden.load(entry.name).facts
    assert facts["log"] == (entry.sha256 or "made by tests/daemon/replay/room.py")
    assert len(facts["reason"]) > 10
    assert (golden.FOLDER / f"{entry.name}.txt").stat().st_size < 20_000


def test_a_change_of_two_micrometres_is_seen(tmp_path: object, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(golden, "FOLDER", tmp_path)
    poses = np.random.default_rng(1).normal(size=(25, 3))
    trajectory = Trajectory(np.arange(25.0), poses)
    golden.save("x", trajectory, 10, golden.facts_of(trajectory, "", "a test"))
    blessed = golden.load("x")
    assert golden.largest_difference(blessed, trajectory, 10) <= golden.TIGHT_M
    assert golden.largest_difference(blessed, trajectory, 10, motion=True) <= 4 * golden.TIGHT_M
    turned = poses @ np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]) + (3.0, -5.0, np.pi / 2)
    elsewhere = Trajectory(np.arange(25.0), turned)
    assert golden.largest_difference(blessed, elsewhere, 10, motion=True) < 1e-5  # the same drive in another frame
    assert golden.largest_difference(blessed, elsewhere, 10) > 1.0
    moved = poses.copy()
    moved[20, 0] += 2e-6
    assert golden.largest_difference(blessed, Trajectory(np.arange(25.0), moved), 10) > golden.TIGHT_M
    between = poses.copy()
    between[13, 1] += 2e-6  # not among the kept poses: the digest tells
    assert golden.digest(Trajectory(np.arange(25.0), between)) != blessed.facts["digest"]
    assert golden.largest_difference(blessed, Trajectory(np.arange(24.0), poses[:24]), 10) == float("inf")
