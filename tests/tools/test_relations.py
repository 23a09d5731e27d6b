"""The relations metric against the definition of its paper."""

import math

import numpy as np
import pytest

from tools.relations import evaluate


def drive() -> tuple[np.ndarray, np.ndarray]:
    stamps = 1e9 + 0.1 * np.arange(200)
    yaw = 2 * np.sin(0.03 * np.arange(200))
    steps = 0.05 * np.column_stack([np.cos(yaw), np.sin(yaw)])
    return stamps, np.column_stack([np.cumsum(steps, axis=0), yaw])


def related(stamps: np.ndarray, poses: np.ndarray, i: np.ndarray, j: np.ndarray) -> np.ndarray:
    c, s = np.cos(poses[i, 2]), np.sin(poses[i, 2])
    dx, dy = (poses[j] - poses[i])[:, :2].T
    return np.column_stack([stamps[i], stamps[j], c * dx + s * dy, c * dy - s * dx, poses[j, 2] - poses[i, 2]])


def test_truth_has_no_error_wherever_the_map_begins() -> None:
    stamps, poses = drive()
    i, j = np.random.default_rng(0).integers(0, 200, (2, 300))
    told = related(stamps, poses, i, j)
    turn = 1.234
    c, s = math.cos(turn), math.sin(turn)
    moved = np.column_stack(
        [c * poses[:, 0] - s * poses[:, 1] + 5, s * poses[:, 0] + c * poses[:, 1] - 3, poses[:, 2] + turn]
    )
    shuffled = np.random.default_rng(1).permutation(200)
    for path in (poses, moved):
        errors = evaluate(stamps[shuffled], path[shuffled], told)
        assert errors.missing == 0
        assert errors.translation_m.max() < 1e-9
        assert errors.rotation_deg.max() < 1e-6


def test_an_error_is_counted_once_and_in_its_unit() -> None:
    stamps, poses = drive()
    told = related(stamps, poses, np.array([3, 10]), np.array([50, 190]))
    told[0, 2] += 0.03
    told[0, 3] -= 0.04
    told[1, 4] += math.radians(2) + 2 * math.pi
    errors = evaluate(stamps, poses, told)
    assert errors.translation_m == pytest.approx([0.05, 0.0], abs=1e-9)
    assert errors.rotation_deg == pytest.approx([0.0, 2.0], abs=1e-6)
    assert errors.within(5.0).translation_m == pytest.approx([0.05])
    assert errors.beyond(5.0).rotation_deg == pytest.approx([2.0])
