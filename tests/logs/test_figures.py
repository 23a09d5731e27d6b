"""Every log gives the trajectory that was blessed, and real ones reach their figures, at the end and published live.

In one file, which one process runs: each log is replayed once for all that looks at it.
"""

import math
from pathlib import Path

import numpy as np
import pytest

from hal.odometry import RawOdometry
from hal.replay.carmen import read_carmen
from tests.logs import golden
from tests.logs.catalog import ledger_of
from tests.logs.conftest import Replayed
from tests.logs.entries import ENTRIES, Entry
from tools.relations import evaluate, read_relations


def cases() -> list[object]:
    return [pytest.param(entry, id=entry.name, marks=[pytest.mark.slow] if entry.heavy else []) for entry in ENTRIES]


@pytest.mark.parametrize("entry", cases())
def test_the_trajectories_are_the_blessed_ones(entry: Entry, outcome_of: Replayed) -> None:
    verdict = golden.held(entry.name, ledger_of(outcome_of(entry.name)), entry.every)
    assert verdict.same, f"{entry.name}: {verdict.said}; look at the change; if it is meant: {golden.REMEDY}"


def test_intel_against_relations_found_by_hand(outcome_of: Replayed, log_root: Path) -> None:
    ledger = ledger_of(outcome_of("intel"))
    relations = read_relations(log_root / "intel" / "intel.relations")
    for trajectory in (ledger.final(), ledger.online()):
        errors = evaluate(trajectory.stamps, trajectory.poses, relations)
        assert errors.missing == 0
        local = errors.within(30.0)
        assert len(local.translation_m) == 1773
        assert local.translation_m.mean() <= 0.022
        assert local.rotation_deg.mean() <= 0.55
    closed = evaluate(ledger.final().stamps, ledger.final().poses, relations)
    assert closed.translation_m.mean() <= 0.026
    assert closed.rotation_deg.mean() <= 0.60
    alone = evaluate(ledger.final().stamps, ledger.odom(), relations).within(30.0)  # without loops: the front end
    assert alone.translation_m.mean() <= 0.0165
    assert alone.rotation_deg.mean() <= 0.385


def test_the_metric_gives_the_published_figure_for_raw_odometry(log_root: Path) -> None:
    """Raw odometry on the same relations, as measured with the benchmark's own program."""
    log = read_carmen(log_root / "intel" / "intel.clf.gz")
    poses = np.array([(e.x, e.y, e.yaw) for e in log.events(0.0) if isinstance(e, RawOdometry)])
    errors = evaluate(log.stamps, poses, read_relations(log_root / "intel" / "intel.relations"))
    assert errors.translation_m.mean() == pytest.approx(7.37, abs=0.005)
    assert errors.translation_m.std(ddof=1) == pytest.approx(14.35, abs=0.005)
    assert errors.rotation_deg.mean() == pytest.approx(39.2, abs=0.05)
    local = errors.within(30.0)
    assert local.translation_m.mean() == pytest.approx(0.026, abs=0.0005)
    assert local.rotation_deg.mean() == pytest.approx(1.51, abs=0.005)


def test_intel_never_jumps(outcome_of: Replayed) -> None:
    """T_odom_base moves with the wheels: no step beyond theirs by more than a match may correct."""
    outcome = outcome_of("intel")
    ledger = ledger_of(outcome)
    assert ledger.jumps <= len(ledger.loops)  # T_map_odom jumps where a loop is closed, and nowhere else
    poses = ledger.odom()
    readings = [e for e in read_carmen(outcome.source.path).events(0.0) if isinstance(e, RawOdometry)]
    wheels = np.array([(e.x, e.y, e.yaw) for e in readings])
    assert len(poses) == len(wheels)

    def motion(path: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        turn = np.diff(path[:, 2])
        return np.hypot(*np.diff(path[:, :2], axis=0).T), np.remainder(turn + math.pi, 2 * math.pi) - math.pi

    (way, turn), (wheel_way, wheel_turn) = motion(poses), motion(wheels)
    assert np.abs(way - wheel_way).max() < 0.15
    assert np.abs(np.remainder(turn - wheel_turn + math.pi, 2 * math.pi) - math.pi).max() < math.radians(12)


def test_replay_is_faster_than_the_drive(outcome_of: Replayed) -> None:
    """A hundred times real time is the figure, by the benchmark on an idle machine; here with fourfold slack."""
    outcome = outcome_of("intel")
    assert len(ledger_of(outcome)) == 13631
    assert 2690.0 / outcome.seconds["run"] >= 100.0 / 4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["aces", "utm"])
def test_every_scan_has_its_pose(name: str, outcome_of: Replayed) -> None:
    outcome = outcome_of(name)
    ledger = ledger_of(outcome)
    assert len(ledger) == outcome.source.status.scans
    assert ledger.dropped == 0
    assert ledger.matched >= 0.99 * len(ledger)
