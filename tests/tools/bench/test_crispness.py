"""Crispness: what the measure counts, and that ours is no worse than scan-to-scan matching on real logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from tools.bench import crispness
from tools.bench.crispness import APART_S, FAR_M, LOGS, best_peer, load, nearest_of_other_times, wheels_at


def test_a_scan_cannot_vouch_for_itself_nor_for_its_neighbour() -> None:
    """Three scans of one wall, the last one 2 cm off: the first two are too close in time to count for each other."""
    wall = np.column_stack((np.arange(200) * 0.01, np.zeros(200)))
    points = np.concatenate((wall, wall, wall + np.array((0.0, 0.02))))
    times = np.repeat((0.0, 0.5 * APART_S, 3.0 * APART_S), 200)
    found = nearest_of_other_times(points, times)
    np.testing.assert_allclose(found, 0.02, atol=1e-9)


def test_what_nobody_else_has_seen_counts_in_full() -> None:
    points = np.array(((0.0, 0.0), (5.0, 0.0), (0.01, 0.0)))
    found = nearest_of_other_times(points, np.array((0.0, 0.0, 10.0)))
    np.testing.assert_allclose(found, (0.01, FAR_M, 0.01))


def test_wheels_are_interpolated_over_a_half_turn() -> None:
    readings = np.array(((0.0, 0.0, 0.0, 3.1), (1.0, 1.0, 2.0, -3.1)))
    at = wheels_at(readings, np.array((0.5,)))
    np.testing.assert_allclose(at[0, :2], (0.5, 1.0))
    assert abs(abs(at[0, 2]) - np.pi) < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize("name", LOGS)
def test_our_map_is_no_less_crisp_than_scan_to_scan(name: str, log_root: Path) -> None:
    drive = load(log_root / LOGS[name])
    assert 0.0 < crispness.crispness(drive, drive.ours) <= best_peer(drive)
