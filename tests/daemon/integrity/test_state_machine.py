"""The state machine: every state and reason by the evidence that should lead there, and what must never be said."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.health.reasons import REASONS, Reason
from daemon.integrity import state_machine as rules
from daemon.integrity.evidence import SILENT_PERIODS, VAGUE_M, Evidence, Light, Match
from daemon.integrity.state_machine import judge
from daemon.integrity.state_memory import FAILED_SCANS, Memory
from daemon.snapshot import State
from tests.daemon.integrity.judged_steps import ALL, BAD, CORRIDOR, LIT, PERIOD, run, said, scans, seen, tracking


def test_before_the_first_scan() -> None:
    assert said(Memory()) == (State.STARTING, Reason.WARMING_UP)
    assert said(judge(Memory(), Evidence(0.0))) == (State.STARTING, Reason.OPENING_LIDAR)
    assert said(judge(Memory(), Evidence(0.0, unreachable=True))) == (State.NO_LIDAR, Reason.LIDAR_UNREACHABLE)


def test_the_first_scan_makes_the_map_and_proves_nothing() -> None:
    first = Evidence(0.0, silence=0.1, match=None, mapped=False)
    assert said(judge(Memory(), first)) == (State.MAPPING, Reason.UNPROVED)


def test_a_laser_alone_is_believed_after_it_has_proved_itself_and_not_before() -> None:
    evidence = scans(0.0, 100)
    memory, first = Memory(), None
    for item in evidence:
        memory = judge(memory, item)
        if memory.state is State.TRACKING and first is None:
            first = item.t_mono
    assert first == pytest.approx(rules.PROOF_S, abs=1.5 * PERIOD)
    assert said(memory) == (State.TRACKING, Reason.NONE)


def test_two_agreeing_witnesses_are_believed_sooner() -> None:
    count = round((rules.CLEAN_S + 0.8) / PERIOD)
    assert run(Memory(), scans(0.0, count, agree=True, odometry=True)).state is State.TRACKING
    assert run(Memory(), scans(0.0, count)).state is State.MAPPING


def test_silence_of_three_periods_is_no_lidar_and_not_a_moment_before() -> None:
    memory = tracking()
    t = 3.0
    assert judge(memory, Evidence(t, silence=2.9, mapped=True)).state is State.TRACKING
    gone = judge(memory, Evidence(t, silence=3.0, mapped=True))
    assert said(gone) == (State.NO_LIDAR, Reason.LIDAR_SILENT)
    assert gone.known == (False, False, False)
    assert judge(gone, Evidence(t, silence=4.0, mapped=True, unreachable=True)).reason is Reason.LIDAR_UNREACHABLE


def test_after_a_short_silence_the_pose_is_proved_again() -> None:
    gone = judge(tracking(), Evidence(3.2, silence=3.0, mapped=True))
    back = judge(gone, seen(3.3))
    assert said(back) == (State.MAPPING, Reason.UNPROVED)
    assert run(back, scans(3.4, 25)).state is State.TRACKING


def test_after_a_long_blind_gap_the_proof_takes_longer() -> None:
    gone = run(tracking(), [Evidence(3.0 + i, silence=3.0 + 10 * i, mapped=True) for i in range(5)])
    assert gone.doubt
    soon = run(gone, scans(8.0, 30))
    assert said(soon) == (State.MAPPING, Reason.UNPROVED)
    assert run(soon, scans(11.0, 25)).state is State.TRACKING


def test_odometry_through_the_gap_leaves_no_doubt() -> None:
    gaps = [Evidence(3.0 + i, silence=3.0 + 10 * i, mapped=True, odometry=True) for i in range(5)]
    assert not run(tracking(odometry=True), gaps).doubt


def test_one_bad_scan_is_no_news_three_are() -> None:
    memory = tracking(odometry=True)
    assert run(memory, scans(3.0, 2, BAD, odometry=True)).state is State.TRACKING
    failed = run(memory, scans(3.0, 3, BAD, odometry=True))
    assert said(failed) == (State.DEGRADED, Reason.MATCH_FAILED)
    assert failed.known == (False, False, False)


def test_without_odometry_a_pose_is_held_for_a_second_only() -> None:
    memory = run(tracking(), scans(3.0, 5, BAD))
    assert said(memory) == (State.DEGRADED, Reason.MATCH_FAILED)
    memory = run(memory, scans(3.5, 10, BAD))
    assert said(memory) == (State.LOST, Reason.NO_WITNESS)


def test_a_lost_pose_is_confirmed_for_longer_before_it_is_said_again() -> None:
    lost = run(tracking(), scans(3.0, 20, BAD))
    fits = run(lost, scans(5.0, 6))
    assert said(fits) == (State.RELOCATING, Reason.CONFIRMING)
    assert run(fits, scans(5.6, 30)).state is State.RELOCATING
    assert said(run(fits, scans(5.6, 60))) == (State.TRACKING, Reason.NONE)
    assert run(fits, scans(5.6, 1, BAD)).state is State.LOST


def test_lost_stays_lost_through_a_silence() -> None:
    lost = run(tracking(), scans(3.0, 20, BAD))
    gone = judge(lost, Evidence(6.0, silence=4.0, mapped=True))
    assert gone.state is State.NO_LIDAR
    assert judge(gone, seen(6.1)).state is State.LOST


def test_an_unobservable_axis_degrades_and_is_named() -> None:
    memory = run(tracking(), scans(3.0, 3, CORRIDOR))
    assert (memory.state, memory.known) == (State.TRACKING, ALL)
    memory = judge(memory, seen(3.31, CORRIDOR))
    assert said(memory) == (State.DEGRADED, Reason.AXIS_UNKNOWN)
    assert memory.known == (False, True, True)
    memory = run(memory, scans(4.0, 7))
    assert memory.known == ALL
    assert memory.state is State.DEGRADED
    assert run(memory, scans(4.7, 10)).state is State.TRACKING


def test_a_blink_of_an_axis_is_no_news_whatever_the_scan_rate() -> None:
    quick = [seen(3.0 + 0.025 * i, CORRIDOR) for i in range(11)]
    assert run(tracking(), quick).known == ALL
    assert run(tracking(), [*quick, seen(3.301, CORRIDOR)]).known == (False, True, True)
    slow = [seen(3.0 + 0.5 * i, CORRIDOR) for i in range(2)]
    assert run(tracking(), slow).known == ALL, "two scans could both be unlucky"


def test_a_start_in_a_corridor_is_degraded_not_tracking() -> None:
    assert said(run(Memory(), scans(0.0, 100, CORRIDOR))) == (State.DEGRADED, Reason.AXIS_UNKNOWN)


def test_disagreement_has_to_last_and_then_degrades_while_it_lasts() -> None:
    memory = run(tracking(odometry=True), scans(3.0, 9, agree=False, odometry=True))
    assert memory.state is State.TRACKING
    memory = run(memory, scans(3.9, 3, agree=False, odometry=True))
    assert said(memory) == (State.DEGRADED, Reason.WITNESSES_DISAGREE)
    assert run(memory, scans(4.2, 100, agree=False, odometry=True)).state is State.DEGRADED
    assert run(memory, scans(4.2, 2, agree=True, odometry=True)).state is State.TRACKING


def test_configured_odometry_that_does_not_arrive_is_a_missing_witness() -> None:
    assert said(judge(tracking(), seen(3.0, odometry=False))) == (State.DEGRADED, Reason.ODOMETRY_SILENT)


def test_uncertainty_degrades_then_loses() -> None:
    vague = judge(tracking(), seen(3.0, sigma_m=1.1 * VAGUE_M))
    assert said(vague) == (State.DEGRADED, Reason.UNCERTAIN)
    assert said(judge(vague, seen(3.1, sigma_rad=1.1 * rules.LOST_RAD))) == (State.LOST, Reason.UNCERTAIN)


def test_a_guess_is_degraded_and_called_one_and_after_a_loss_it_is_lost() -> None:
    memory = run(tracking(), scans(3.0, 30, CORRIDOR, guessed=True))
    assert said(memory) == (State.DEGRADED, Reason.UNCERTAIN)
    lost = run(tracking(), scans(3.0, 20, BAD))
    assert said(run(lost, scans(5.0, 100, CORRIDOR, guessed=True))) == (State.LOST, Reason.UNCERTAIN)


def test_looking_for_the_place() -> None:
    memory = tracking()
    assert said(judge(memory, seen(3.0, places=0))) == (State.RELOCATING, Reason.SEARCHING)
    assert said(judge(memory, seen(3.0, places=3))) == (State.AMBIGUOUS, Reason.SEVERAL_PLACES)
    assert said(judge(memory, seen(3.0, places=1))) == (State.RELOCATING, Reason.CONFIRMING)


def test_a_place_that_was_found_has_to_be_proved() -> None:
    """Scans that fitted while the place was looked for say nothing of it, nor does the motion on which all agree."""
    memory = run(tracking(odometry=True), scans(3.0, 30, odometry=True, agree=True, places=1))
    assert memory.doubt
    soon = run(memory, scans(6.0, int(9.0 * rules.RELOCATED_PROOF_S), odometry=True, agree=True))
    assert soon.state is not State.TRACKING
    t = 6.0 + 0.9 * rules.RELOCATED_PROOF_S
    assert run(soon, scans(t, 10, odometry=True, agree=True)).state is State.TRACKING


def test_an_order_starts_the_proof_anew() -> None:
    memory = judge(tracking(), seen(3.0, ordered=True))
    assert memory.good == 1
    lost = run(tracking(), scans(3.0, 20, BAD))
    assert judge(lost, seen(5.0, ordered=True)).state is not State.LOST


@pytest.mark.parametrize("why", [Reason.PAUSED, Reason.OVERLOADED])
def test_a_laser_that_is_left_out_degrades_and_says_why(why: Reason) -> None:
    paused = run(tracking(odometry=True), scans(3.0, 30, None, odometry=True, unused=why))
    assert said(paused) == (State.DEGRADED, why)
    assert paused.known == (False, False, False)
    assert not paused.doubt  # odometry has carried the pose
    lost = judge(paused, seen(6.0, None, sigma_m=1.1 * rules.LOST_M, unused=why))
    assert said(lost) == (State.LOST, why if why is Reason.PAUSED else Reason.UNCERTAIN)
    contradicted = scans(6.0, 5, None, light=replace(LIT, agrees=False), odometry=True, unused=why)
    assert said(run(paused, contradicted)) == (State.DEGRADED, Reason.LIGHT_DISAGREES)
    assert run(paused, scans(6.0, 40, odometry=True)).state is State.TRACKING


def test_a_pause_without_odometry_leaves_a_place_in_doubt() -> None:
    paused = run(tracking(), scans(3.0, 30, None, unused=Reason.PAUSED))
    assert paused.doubt
    lost = msgspec.structs.replace(tracking(), lost=True, doubt=True)
    assert said(judge(lost, seen(3.0, None, unused=Reason.PAUSED))) == (State.LOST, Reason.PAUSED)


def test_a_lost_place_is_what_is_told_whether_the_computer_is_too_slow_or_not() -> None:
    lost = run(tracking(), scans(3.0, 30, BAD))
    assert said(lost) == (State.LOST, Reason.NO_WITNESS)
    vague = judge(tracking(), seen(3.0, sigma_rad=1.1 * rules.LOST_RAD))
    assert said(vague) == (State.LOST, Reason.UNCERTAIN)
    for before in (lost, vague):
        slow = run(before, scans(6.0, 30, None, unused=Reason.OVERLOADED))
        assert said(slow) == said(before)
        paused = judge(slow, seen(9.0, None, unused=Reason.PAUSED))
        assert said(paused) == (State.LOST, Reason.PAUSED)
        assert said(judge(paused, seen(9.1, None, unused=Reason.OVERLOADED))) == (State.LOST, Reason.NO_WITNESS)


def test_every_reason_has_a_meaning_and_every_trouble_a_remedy() -> None:
    assert set(REASONS) == set(Reason)
    assert all(meaning for meaning, _ in REASONS.values())
    assert [reason for reason, (_, remedy) in REASONS.items() if not remedy] == [Reason.NONE]


offs = st.sampled_from([0.0, 0.1, 1.0])
matches = st.none() | st.builds(
    Match, st.booleans(), st.tuples(st.booleans(), st.booleans(), st.booleans()), offs, offs
)
lights = st.none() | st.builds(
    Light,
    alive=st.sampled_from([True, True, False]),
    used=st.booleans(),
    placed=st.sampled_from([True, True, False]),
    lost=st.sampled_from([False, False, True]),
    agrees=st.sampled_from([True, None, False]),
    moved=st.sampled_from([False, False, True]),
    known=st.just(ALL) | st.tuples(st.booleans(), st.booleans(), st.booleans()),
)
evidences = st.lists(
    st.builds(
        Evidence,
        t_mono=st.floats(0.001, 0.5),  # made cumulative below
        silence=st.none() | st.floats(0.0, 6.0),
        unreachable=st.booleans(),
        match=matches,
        mapped=st.booleans(),
        sigma_m=st.sampled_from([0.0, 0.0, 0.2, 3.0]),
        sigma_rad=st.sampled_from([0.0, 0.0, 0.2, 3.0]),
        guessed=st.booleans(),
        odometry=st.sampled_from([None, True, False]),
        agree=st.sampled_from([None, True, False]),
        places=st.sampled_from([None, None, None, 0, 1, 2]),
        ordered=st.sampled_from([False, False, True]),
        light=lights,
        unused=st.sampled_from([None, None, None, Reason.PAUSED, Reason.OVERLOADED]),
        recalled=st.sampled_from([False, False, True]),
    ),
    max_size=60,
)


@given(steps=evidences)
def test_what_must_hold_whatever_happens(steps: list[Evidence]) -> None:
    memory, t = tracking(odometry=True), 3.0
    for step in steps:
        t += step.t_mono
        evidence = replace(step, t_mono=t)
        memory = judge(memory, evidence)
        if memory.state is State.TRACKING:
            assert all(memory.known)
            assert evidence.places is None
            assert evidence.unused is None
            assert evidence.silence is not None
            assert evidence.silence < SILENT_PERIODS
            assert memory.failed < FAILED_SCANS
            assert evidence.odometry is not False
            assert evidence.sigma_m <= VAGUE_M
            assert not memory.lost
            assert not memory.doubt
            if evidence.light is not None:
                assert evidence.light.alive
                assert evidence.light.placed
                assert not evidence.light.lost
                assert memory.odd_since is None or t - memory.odd_since < rules.CONTRADICTED_S
        assert (memory.reason is Reason.NONE) == (memory.state is State.TRACKING)
        if evidence.silence is not None and evidence.silence >= SILENT_PERIODS:
            held = evidence.light is not None and evidence.light.placed
            assert memory.state is not State.TRACKING
            assert held or memory.state is State.NO_LIDAR


@given(steps=evidences)
def test_from_anywhere_good_scans_lead_back_to_tracking(steps: list[Evidence]) -> None:
    memory, t = Memory(), 0.0
    for step in steps:
        t += step.t_mono
        memory = judge(memory, replace(step, t_mono=t))
    memory = run(memory, scans(t + PERIOD, 80))
    assert memory.state is State.TRACKING
