"""From the lights' result to evidence: alive, placed, agreeing, contradicting, and who moved the pose."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from daemon.integrity.evidence import Evidence, Light
from daemon.integrity.observer import LIGHT_SILENT_S, Observer
from estimator.cdma.epoch import BlockFlag, LightEpoch
from estimator.measurements import Record
from estimator.result import SURPRISE, Fix, LightsResult, Link, LinkState, StepResult
from hal import lidar
from tests.daemon.integrity.test_observer import match, step

EPOCH = LightEpoch(
    0.0, 0.05, np.array([3]), np.array([1e-6]), np.array([1e-18]), np.zeros(1, np.int64), (None,), BlockFlag.NONE,
    1e-9, None,
)  # fmt: skip


def links(*states: LinkState) -> tuple[Link, ...]:
    return tuple(Link(k, k, state, 1e-6) for k, state in enumerate(states))


def lit(fix: Fix = Fix.GOOD, seen: tuple[Link, ...] = links(*[LinkState.ACCEPTED] * 3)) -> LightsResult:
    accepted = frozenset(link.code for link in seen if link.state is LinkState.ACCEPTED)
    zero, none = np.zeros(3), np.zeros((3, 3))
    return LightsResult(0.05, fix, zero, 1e-4 * np.eye(3), seen, accepted, none, zero)


def result(lights: LightsResult, placed: bool = True, gap: float | None = 1.0, jumps: int = 0) -> StepResult:
    return replace(step(match()), lights=lights, placed=placed, gap=gap, jumps=jumps)


class Watch:
    """An observer of a robot with laser and photodiode."""

    def __init__(self) -> None:
        self.observer = Observer(0.0, odometry=False, lidar=True, lights=True)
        self.t = 0.0

    def see(self, seen: StepResult | None, *records: Record, dt: float = 0.1) -> Evidence:
        self.t += dt
        self.observer.on_scan(self.t)
        status = lidar.LidarStatus(link=lidar.Link.STREAMING)
        return self.observer.evidence(self.t, 0.1, status, records, seen)

    def light(self, seen: StepResult | None, *records: Record, dt: float = 0.1) -> Light:
        light = self.see(seen, *records, dt=dt).light
        assert light is not None
        return light


def test_without_a_photodiode_light_says_nothing() -> None:
    observer = Observer(0.0, odometry=False)
    assert observer.evidence(0.1, 0.1, lidar.LidarStatus(), (), result(lit())).light is None


def test_light_that_fits_is_used_placed_and_agrees() -> None:
    seen = Watch().light(result(lit()), EPOCH)
    assert seen == Light(alive=True, used=True, placed=True, agrees=True, known=(True, True, True))


def test_samples_that_stop_are_silence_and_what_was_told_is_not_repeated() -> None:
    watch = Watch()
    watch.see(result(lit()), EPOCH)
    silent = watch.light(result(lit()), dt=LIGHT_SILENT_S + 0.1)
    assert (silent.alive, silent.used, silent.agrees) == (False, False, None)
    assert watch.light(None).placed


@pytest.mark.parametrize(
    ("lights", "gap", "agrees"),
    [
        (lit(), SURPRISE + 1.0, False),
        (lit(), None, None),
        (lit(Fix.HELD, links(LinkState.OCCLUDED, LinkState.REJECTED)), None, False),
        (lit(Fix.HELD, links(LinkState.RIM)), None, None),
        (lit(Fix.NONE, links(LinkState.UNSURVEYED)), None, None),
        (lit(seen=links(LinkState.ACCEPTED, LinkState.ACCEPTED, LinkState.OCCLUDED)), 1.0, True),
    ],
)
def test_a_contradiction_is_a_gap_or_lamps_that_do_not_fit(
    lights: LightsResult, gap: float | None, agrees: bool | None
) -> None:
    assert Watch().light(result(lights, gap=gap), EPOCH).agrees is agrees


def test_pose_and_light_that_agree_may_be_apart_while_samples_arrive() -> None:
    watch, apart = Watch(), replace(result(lit()), apart=True)
    assert watch.light(apart, EPOCH).apart
    assert not watch.light(result(lit()), EPOCH).apart
    assert not watch.light(apart, dt=LIGHT_SILENT_S + 0.1).apart


def test_lamps_that_cannot_be_received_at_the_pose_contradict_it_and_two_epochs_of_them_for_good() -> None:
    watch, epochs = Watch(), [replace(lit(Fix.STARTING), t_mono=0.05 * k) for k in range(1, 5)]

    def seen(epoch: LightsResult, misplaced: bool = True) -> tuple[bool | None, bool]:
        light = watch.light(replace(result(epoch, gap=0.1), misplaced=misplaced), EPOCH)
        return light.agrees, light.elsewhere

    assert [seen(epochs[0]) for _ in range(3)] == [(False, False)] * 3, "the same epoch, cycle after cycle"
    assert seen(epochs[1]) == (False, True)
    assert seen(epochs[2], False) == (True, False)
    assert seen(epochs[3]) == (False, False)


def test_lamps_that_fit_again_and_wait_to_be_used_do_not_contradict() -> None:
    fits = replace(links(LinkState.OCCLUDED)[0], residual=0.01, sigma=0.01)
    hidden, strange = replace(fits, residual=-0.5), replace(fits, state=LinkState.REJECTED)
    for first, agrees in ((fits, True), (hidden, False), (strange, False)):
        seen = (*links(LinkState.ACCEPTED, LinkState.ACCEPTED), *[first] * 3)
        assert Watch().light(result(lit(seen=seen)), EPOCH).agrees is agrees


def test_lamps_that_fit_again_and_wait_speak_for_the_place() -> None:
    fits = replace(links(LinkState.OCCLUDED)[0], residual=0.01, sigma=0.01)
    hidden = replace(fits, residual=-0.5)
    for waiting, agrees in ((0, False), (1, True)):
        seen = (*links(LinkState.RIM), hidden, *[fits] * waiting)
        assert Watch().light(result(lit(seen=seen)), EPOCH).agrees is agrees


def test_a_jump_after_a_contradiction_has_moved_the_pose_and_another_has_not() -> None:
    watch = Watch()
    assert not watch.light(result(lit(), jumps=1), EPOCH).moved
    watch.see(result(lit(), gap=100.0, jumps=1), EPOCH)
    assert watch.light(result(lit(), jumps=2), EPOCH).moved
    assert not watch.light(result(lit(), jumps=3), EPOCH).moved


def test_several_places_are_told_until_one_is_left() -> None:
    watch = Watch()
    assert watch.see(result(lit(Fix.AMBIGUOUS), placed=False, gap=None), EPOCH).places == 2
    assert watch.see(result(lit()), EPOCH).places is None


def test_uncertainty_in_the_survey_is_that_of_the_place_itself() -> None:
    P = np.diag((0.04, 0.01, 0.0025))
    seen = Watch().see(replace(result(lit()), covariance=P), EPOCH)
    assert (seen.sigma_m, seen.sigma_rad) == pytest.approx((0.2, 0.05))
