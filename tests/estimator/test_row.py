"""Lamps in one row say little of how far from it the robot is, however often they say it."""

from __future__ import annotations

import math
from heapq import merge

import numpy as np
import pytest

from estimator import row
from estimator.lamps import Lamp, Receiver
from estimator.light import LightsSetup
from estimator.lights_catalogue import Catalogue
from estimator.pipeline import new_state, step
from estimator.records import UNLIMITED, Array, LightEpoch
from tools.experiments.corridor import CASES, drive_of
from tools.experiments.loop_drives import half, room_drive


def catalogue(places: list[tuple[float, float]]) -> Catalogue:
    known = Catalogue(1.0, Receiver())
    for k, (x, y) in enumerate(places):
        known.add(Lamp(k + 1, k + 1, x, y, 2.6))
    return known


def looked_at(
    lamps: set[int], known: Catalogue, before: tuple[float, ...], after: tuple[float, ...], angle: float
) -> tuple[Array, Array]:
    """Step and sigmas (along and across the angle; heading) that are left of a look which moved a pose by 1, 1, 0.1."""
    c, s = math.cos(angle), math.sin(angle)
    R = np.array(((c, -s, 0.0), (s, c, 0.0), (0.0, 0.0, 1.0)))
    P0, P = (R @ np.diag(np.square(sigma)) @ R.T for sigma in (before, after))
    x = R @ np.array((1.0, 1.0, 0.1))
    row.moderate(known, frozenset(lamps), np.zeros(3), P0, x, P)
    assert np.linalg.eigvalsh(P).min() > 0.0
    return R.T @ x, np.sqrt(np.diag(R.T @ P @ R))


ANGLES = pytest.mark.parametrize("angle", [0.0, 0.4, 1.5])


@ANGLES
def test_a_look_makes_a_pose_no_surer_across_a_row_than_it_can_tell(angle: float) -> None:
    c, s = math.cos(angle), math.sin(angle)
    known = catalogue([(3.0 * k * c, 3.0 * k * s) for k in range(4)])
    moved, sigma = looked_at({1, 2, 3, 4}, known, (2.0, 2.0, 0.4), (0.02, 0.02, 0.01), angle)
    assert sigma == pytest.approx((0.02, row.SIDE_M, row.SIDE_RAD), rel=1e-6)
    assert moved[0] == pytest.approx(1.0)
    assert 0.9 < moved[1] < 1.0
    assert 0.09 < moved[2] < 0.1


@ANGLES
def test_what_was_known_better_before_stays_as_it_was(angle: float) -> None:
    """It came from other lamps, and from wheels since; a look at a row neither takes it away nor moves it."""
    c, s = math.cos(angle), math.sin(angle)
    known = catalogue([(3.0 * k * c, 3.0 * k * s) for k in range(4)])
    moved, sigma = looked_at({1, 2, 3, 4}, known, (0.05, 0.04, 0.03), (0.02, 0.02, 0.01), angle)
    assert sigma == pytest.approx((0.02, 0.04, 0.03), rel=1e-6)
    assert moved == pytest.approx((1.0, 0.0, 0.0), abs=1e-9)


def test_a_look_that_is_vaguer_than_that_is_believed() -> None:
    known = catalogue([(0.0, 0.0), (3.0, 0.0)])
    moved, sigma = looked_at({1, 2}, known, (2.0, 2.0, 0.4), (0.7, 0.7, 0.2), 0.0)
    assert sigma == pytest.approx((0.7, 0.7, 0.2))
    assert moved == pytest.approx((1.0, 1.0, 0.1))


def test_a_heading_is_moderated_across_the_half_turn() -> None:
    known = catalogue([(0.0, 0.0), (3.0, 0.0)])
    P0, P, x0, x = np.diag((0.1, 0.1, 0.01**2)), np.diag((0.1, 0.1, 1e-6)), np.zeros(3), np.zeros(3)
    x0[2], x[2] = math.pi - 0.01, -math.pi + 0.01
    row.moderate(known, frozenset({1, 2}), x0, P0, x, P)
    assert math.remainder(x[2] - x0[2], math.tau) == pytest.approx(0.0, abs=1e-9)


def test_two_rows_one_lamp_or_none_change_nothing() -> None:
    known = catalogue([(0.0, 0.0), (3.0, 0.0), (0.0, 2.5), (3.0, 2.5)])
    for lamps in ({1, 2, 3, 4}, {1}, set(), {17}):
        moved, sigma = looked_at(lamps, known, (2.0, 2.0, 0.4), (0.02, 0.02, 0.01), 0.0)
        assert sigma == pytest.approx((0.02, 0.02, 0.01), abs=2e-4)
        assert moved == pytest.approx((1.0, 1.0, 0.1), abs=1e-3)


@pytest.mark.jit
@pytest.mark.parametrize("seed", [18, 14])
def test_a_row_of_lamps_now_and_then_does_not_make_a_robot_in_a_room_forget_its_heading(seed: int) -> None:
    """Lamps that are hidden leave a row for a moment; the heading was known better before, and by wheels since."""
    run = room_drive(seed, 80.0)
    state, worst = new_state(None, LightsSetup(run.survey, clock_ppm=0.0)), []
    for record in merge(run.odometry(), half(run.light()), key=lambda one: one.t_end):
        result = step(state, [record], UNLIMITED)
        if record.t_end > 30.0 and isinstance(record, LightEpoch) and result.lights is not None:
            worst.append(math.sqrt(result.lights.covariance[2, 2]))
    assert len(worst) > 400
    assert max(worst) < 0.05


@pytest.mark.jit
def test_along_a_corridor_light_alone_does_not_become_certain_of_a_wrong_side() -> None:
    """Walls beside make lamps that are farther look stronger than in a room: 65 cm off, which it held to 11 cm."""
    run = drive_of(CASES[1], 1)
    state = new_state(None, LightsSetup(run.survey, clock_ppm=0.0))
    worst = []
    for record in merge(run.odometry(), half(run.light()), key=lambda one: one.t_end):
        if record.t_end > 40.0:
            break
        result = step(state, [record], UNLIMITED)
        if record.t_end > 15.0 and isinstance(record, LightEpoch) and result.lights is not None:
            off = result.lights.T_map_base - run.truth(np.array([result.lights.t_pose]))[0]
            off[2] = math.remainder(off[2], math.tau)
            worst.append(np.abs(off) / np.sqrt(np.diag(result.lights.covariance)))
    across, heading = np.array(worst)[:, 0], np.array(worst)[:, 2]  # the corridor lies along y
    assert len(worst) > 100
    assert np.median(across) < 3.5
    assert np.median(heading) < 2.0
