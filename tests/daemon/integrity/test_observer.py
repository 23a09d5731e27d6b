"""From step results to evidence: what a good match is, what nothing has witnessed, who has fallen silent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daemon.integrity.arrival_monitor import ODOMETRY_SILENT_S
from daemon.integrity.evidence import VAGUE_M, Evidence
from daemon.integrity.observer import ENOUGH_INLIERS, OPENING_S, Observer, good
from estimator.measurements import Array, Command, Odometry, Order, Record
from estimator.result import Loop, LoopReason, MatchResult, Reason, StepResult
from hal.lidar import LidarStatus, Link

STREAMING = LidarStatus(link=Link.STREAMING)
SURE = np.diag((1e-6, 1e-6, 1e-6))
GUESS = np.diag(((2 * VAGUE_M) ** 2, 1e-4, 1e-4))


def match(
    inliers: int = 600, reason: Reason = Reason.CONVERGED, known: tuple[int, int, int] = (1, 1, 1)
) -> MatchResult:
    zero = np.zeros(3)
    axes = np.array(known, dtype=float)
    return MatchResult(zero, np.eye(3), inliers, 682, 5, 0.01, axes, zero, reason)


def step(found: MatchResult | None, P: Array = SURE, t_mono: float = 0.0, x: float = 0.0) -> StepResult:
    zero = np.zeros(3)
    return StepResult(
        t_mono=t_mono,
        T_odom_base=np.array((x, 0.0, 0.0)),
        T_map_odom=zero,
        covariance=P,
        velocity=zero,
        known_axes=np.ones(3) if found is None else found.known_axes,
        match=found,
        keyframe=-1,
        loop=None,
        anchor=0,
        T_anchor_base=zero,
        jumps=0,
    )


class Watch:
    """An observer and a time that goes on by itself."""

    def __init__(self, odometry: bool = False) -> None:
        self.observer = Observer(0.0, odometry)
        self.t = 0.0

    def see(self, result: StepResult | None, *records: Record, status: LidarStatus = STREAMING) -> Evidence:
        self.t += 0.1
        self.observer.on_scan(self.t)
        return self.observer.evidence(self.t, 0.1, status, records, result)


@pytest.mark.parametrize(
    ("found", "expected"),
    [
        (match(), True),
        (match(reason=Reason.ITERATION_CAP), True),
        (match(reason=Reason.REJECTED), False),
        (match(reason=Reason.TOO_FEW_PAIRS), False),
        (match(inliers=round(682 * ENOUGH_INLIERS) + 1), True),
        (match(inliers=round(682 * ENOUGH_INLIERS) - 1), False),
        (replace(match(), T_odom_base=np.array((np.nan, 0, 0))), False),
    ],
)
def test_a_good_match_is_a_result_that_enough_of_the_scan_took_part_in(found: MatchResult, expected: bool) -> None:
    assert good(found) is expected


def test_the_first_scan_has_nothing_to_match_against() -> None:
    evidence = Watch().see(step(match(reason=Reason.NO_MAP)))
    assert (evidence.match, evidence.mapped) == (None, False)


def test_drift_from_scan_to_scan_is_no_uncertainty_of_the_place() -> None:
    watch = Watch()
    for i in range(200):
        evidence = watch.see(step(match(), SURE * (1 + 1000 * i)))
    assert (evidence.sigma_m, evidence.sigma_rad) == (0.0, 0.0)


def test_a_guess_stays_one_although_later_scans_fit_the_map_laid_upon_it() -> None:
    watch = Watch()
    watch.see(step(match()))
    watch.see(step(match(reason=Reason.TOO_FEW_PAIRS), GUESS))
    for _ in range(50):
        evidence = watch.see(step(match(), GUESS + SURE))
    assert evidence.sigma_m == pytest.approx(2 * VAGUE_M, rel=1e-2)
    assert watch.see(step(match(), SURE)).sigma_m == 0.0, "the estimate itself has become certain again"


def test_what_odometry_bridged_is_drift_not_a_guess() -> None:
    watch = Watch(odometry=True)
    watch.see(step(match()))
    watch.observer.on_odometry(watch.t)
    assert watch.see(step(match(known=(0, 1, 1)), GUESS)).sigma_m > VAGUE_M
    watch.observer.on_odometry(watch.t)
    assert watch.see(step(match(), GUESS)).sigma_m == 0.0


@pytest.mark.parametrize("order", [order for order in Order if order is not Order.REMEMBERED])
def test_an_order_ends_the_doubt(order: Order) -> None:
    watch = Watch()
    watch.see(step(match()))
    assert watch.see(step(match(), GUESS)).sigma_m > VAGUE_M
    evidence = watch.see(step(match(), GUESS), Command(watch.t, order))
    assert (evidence.ordered, evidence.sigma_m) == (True, 0.0)


def after(watch: Watch, seconds: float, found: MatchResult, keyframes: bool) -> Evidence:
    """Scans at 10 Hz, a keyframe with every second of them."""
    for i in range(round(seconds * 10)):
        laid = i if keyframes and i % 2 else -1
        evidence = watch.see(replace(step(found), keyframe=laid))
    return evidence


def test_a_map_laid_along_an_axis_that_nothing_showed_is_a_guess_for_good() -> None:
    watch = Watch()
    after(watch, 1.0, match(), keyframes=True)
    assert not after(watch, 0.4, match(known=(1, 0, 1)), keyframes=True).guessed, "a velocity carries that far"
    assert after(watch, 2.0, match(known=(1, 0, 1)), keyframes=True).guessed
    room = after(watch, 5.0, match(), keyframes=True)
    assert room.guessed
    assert room.match is not None
    assert room.match.known == (True, False, True), "the scans fit, but the place in the map is not known"
    ordered = watch.see(step(match()), Command(watch.t, Order.SET_POSE))
    assert not ordered.guessed
    assert ordered.match is not None
    assert ordered.match.known == (True, True, True)


def test_a_loop_closure_tells_the_place() -> None:
    watch = Watch()
    after(watch, 1.0, match(), keyframes=True)
    assert after(watch, 2.0, match(known=(0, 0, 1)), keyframes=True).guessed
    assert not watch.see(replace(step(match()), loop=Loop(1, 9, 2, 0.01))).guessed


def test_a_map_begun_anew_is_a_guess_whatever_fits_it() -> None:
    """The robot may have been kidnapped before: odometry carries the pose, and only a search can confirm it."""
    watch = Watch(odometry=True)
    assert not watch.see(step(match())).guessed
    begun = watch.see(replace(step(match()), anew=1, dead_reckoned=True))
    assert begun.guessed
    assert begun.match is not None
    assert begun.match.known == (False, False, False)
    later = watch.see(replace(step(match()), anew=1, dead_reckoned=True))
    assert later.guessed
    ordered = watch.see(replace(step(match()), anew=1, dead_reckoned=True), Command(0.0, Order.SET_POSE, np.zeros(3)))
    assert not ordered.guessed
    assert not watch.see(replace(step(match()), anew=1)).guessed
    assert watch.see(replace(step(match()), anew=2, dead_reckoned=True)).guessed, "and begun once more"


@pytest.mark.parametrize(("reason", "tells"), [(why, why.name in ("PLACED", "LIT")) for why in LoopReason])
def test_after_a_map_was_begun_anew_only_a_search_everywhere_tells_the_place(reason: LoopReason, tells: bool) -> None:
    """A robot that was carried off to where it looks alike closes loops there as it would at the right place."""
    watch = Watch(odometry=True)
    watch.see(step(match()))
    watch.see(replace(step(match()), anew=1, dead_reckoned=True))
    found = replace(step(match()), anew=1, dead_reckoned=not tells, loop=Loop(1, 9, 2, 0.01, reason))
    assert watch.see(found).guessed is not tells


def test_a_pose_by_dead_reckoning_is_a_guess_although_no_map_was_begun_anew() -> None:
    """A search that its cap ended leaves the pose unconfirmed, without a restart of the local map."""
    watch = Watch(odometry=True)
    watch.see(step(match()))
    watch.observer.on_odometry(watch.t)
    assert watch.see(replace(step(match()), dead_reckoned=True)).guessed
    assert watch.see(replace(step(match()), dead_reckoned=True, loop=Loop(1, 9, 2, 0.01, LoopReason.NEAR))).guessed
    assert not watch.see(replace(step(match()), loop=Loop(2, 9, 2, 0.01, LoopReason.PLACED))).guessed


def test_a_map_begun_anew_is_no_guess_where_wheels_have_carried_the_pose() -> None:
    watch = Watch(odometry=True)
    watch.see(step(match()))
    watch.observer.on_odometry(watch.t)
    assert not watch.see(replace(step(match()), anew=1)).guessed
    blind = Watch()
    blind.see(step(match()))
    assert blind.see(replace(step(match()), anew=1)).guessed, "nothing has carried it"


def test_no_keyframe_no_guess() -> None:
    """A robot that stands in a corridor, or loses its lidar for a while, finds the map as it was."""
    watch = Watch()
    after(watch, 1.0, match(), keyframes=True)
    after(watch, 20.0, match(known=(1, 0, 1)), keyframes=False)
    room = watch.see(step(match()))
    assert (room.guessed, room.match and room.match.known) == (False, (True, True, True))


def test_failed_matches_that_lay_keyframes_are_a_guess_too() -> None:
    watch = Watch()
    after(watch, 1.0, match(), keyframes=True)
    assert after(watch, 2.0, match(reason=Reason.TOO_FEW_PAIRS, known=(0, 0, 0)), keyframes=True).guessed


def test_odometry_shows_the_motion_along_a_corridor() -> None:
    watch = Watch(odometry=True)
    for i in range(50):
        watch.observer.on_odometry(watch.t)
        evidence = watch.see(replace(step(match(known=(1, 0, 1))), keyframe=i))
    assert not evidence.guessed


def test_a_corridor_does_not_witness_the_motion() -> None:
    """The pose takes the free axis from the wheels; agreement would be an echo of them."""
    watch = Watch(odometry=True)
    for i in range(60):
        t = watch.t
        wheels = Odometry(t, t + 0.1, np.array((0.05, 0.0, 0.0)))
        watch.observer.on_odometry(t)
        known = (1, 1, 1) if i < 40 else (0, 1, 1)
        evidence = watch.see(step(match(known=known), t_mono=t + 0.1, x=0.05 * (i + 1)), wheels)
        if i == 39:
            assert evidence.agree is True
    assert evidence.agree is None


def test_configured_odometry_falls_silent_after_a_second() -> None:
    observer = Observer(0.0, odometry=True)
    assert observer.odometry_ok(0.5) is True, "it may still come"
    assert observer.odometry_ok(ODOMETRY_SILENT_S + 0.1) is False
    observer.on_odometry(5.0)
    assert observer.odometry_ok(5.9) is True
    assert Observer(0.0, odometry=False).odometry_ok(100.0) is None


def test_odometry_that_nobody_configured_counts_once_it_has_come() -> None:
    observer = Observer(0.0, odometry=False)
    observer.on_odometry(1.0)
    assert (observer.odometry_ok(1.5), observer.odometry_ok(3.0)) == (True, False)


def test_a_lidar_is_unreachable_when_its_driver_says_so_or_takes_too_long() -> None:
    observer = Observer(0.0, odometry=False)
    opening, waiting = LidarStatus(link=Link.OPENING), LidarStatus(link=Link.WAITING)
    assert not observer.evidence(1.0, 0.1, opening, (), None).unreachable
    assert observer.evidence(1.0, 0.1, waiting, (), None).unreachable
    assert observer.evidence(1.1, 0.1, opening, (), None).unreachable, "trying again is no news, a scan would be"
    assert observer.evidence(OPENING_S + 1.0, 0.1, opening, (), None).unreachable
    observer.on_scan(12.0)
    late = observer.evidence(12.31, 0.1, opening, (), None)
    assert not late.unreachable
    assert late.silence is not None
    assert late.silence > 3.0
