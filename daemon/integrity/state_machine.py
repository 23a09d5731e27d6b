"""State machine of the published state: pure functions, updated once per cycle with evidence.

TRACKING requires two solutions that agree, or one that is confirmed by itself, and light must not contradict the pose.
Light and lidar can agree on the pose; odometry and lidar can agree on the motion of the last seconds. The lidar is
confirmed by a series of good matches with small corrections on every axis, light by fitting the pose for a while.
Every other state has a reason, and every reason has a remedy. Degradation takes effect fast, recovery slowly.
"""

from __future__ import annotations

from typing import Final

from msgspec.structs import replace

from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS, VAGUE_M, VAGUE_RAD, Evidence, Light
from daemon.integrity.state_memory import AXIS_FOUND_SCANS, DARK_S, FAILED_SCANS, HELD_S, Memory, remember, steady
from daemon.snapshot import State

PROOF_S: Final = 2.0
PROOF_SCANS: Final = 10
"""Consecutive good scans, over at least this time, that confirm a solution."""
RELOCATED_PROOF_S: Final = 5.0
"""The same time after the pose was lost, s: the right position has to be distinguished from a similar one."""
CLEAN_S: Final = 1.0
"""Every axis has to be known for this long (s) before TRACKING is (re-)entered."""
DISAGREE_S: Final = 1.0
"""The solutions have to disagree for this long (s), because stamps jitter."""
LOST_M: Final = 1.0
LOST_RAD: Final = 0.26
"""One-sigma uncertainty beyond which a pose is not usable."""
RECALLED_S: Final = 0.3
"""Confirmation time in s where a pose confirmed before a gap, or in the previous run, is found again unchanged."""
CONTRADICTED_S: Final = 0.3
"""Light has to contradict the pose for this long (s): passing people may spoil one epoch."""
HELD: Final = (State.TRACKING, State.DEGRADED)
"""States with a confirmed pose."""


def judge(memory: Memory, evidence: Evidence) -> Memory:
    """Update the memory with one cycle's evidence; ``state``, ``reason`` and ``known`` of the result are published."""
    if evidence.ordered:
        memory = Memory(memory.state, memory.reason)
    memory = remember(memory, evidence)
    state, reason = _say(memory, evidence)
    lost = state is State.LOST or (memory.lost and state in (State.RELOCATING, State.AMBIGUOUS, State.NO_LIDAR))
    doubt = lost or evidence.places is not None or (memory.doubt and state is not State.TRACKING)
    recalled = memory.recalled and state is not State.TRACKING  # TRACKING ends its purpose
    tracked = state is State.TRACKING or (memory.tracked and not (lost or doubt))
    said = (state, reason, lost, doubt, recalled, tracked)
    if said == (memory.state, memory.reason, memory.lost, memory.doubt, memory.recalled, memory.tracked):
        return memory  # a new struct costs more than this comparison
    return replace(memory, state=state, reason=reason, lost=lost, doubt=doubt, recalled=recalled, tracked=tracked)


def _say(memory: Memory, evidence: Evidence) -> tuple[State, Reason]:
    """State and reason from the decision table, gravest first."""
    if evidence.silence is None or evidence.silence >= SILENT_PERIODS or not steady(memory, evidence.t_mono):
        return _say_without_laser(memory, evidence)
    if evidence.places is not None:
        if evidence.places > 1:
            return State.AMBIGUOUS, Reason.SEVERAL_PLACES
        return State.RELOCATING, Reason.CONFIRMING if evidence.places else Reason.SEARCHING
    if evidence.unused is not None:
        return _say_unused(memory, evidence, evidence.unused)
    if not evidence.mapped:
        return State.MAPPING, Reason.UNPROVED
    if memory.lost and not _proved(memory, evidence):
        if evidence.guessed:
            return State.LOST, Reason.UNCERTAIN
        fits = memory.good >= AXIS_FOUND_SCANS
        return (State.RELOCATING, Reason.CONFIRMING) if fits else (State.LOST, Reason.NO_WITNESS)
    return _say_of_pose(memory, evidence)


def _say_unused(memory: Memory, evidence: Evidence, why: Reason) -> tuple[State, Reason]:
    """Part of the table for an available lidar that is skipped: light and odometry determine the pose, or nothing.

    If the pose is lost during a pause, the remedy is to end the pause, not to drive on. A computer that is too slow has
    a fault of its own, which must not hide the remedy for a lost pose.
    """
    if memory.lost:
        return State.LOST, _why_lost(memory, why)
    if evidence.sigma_m > LOST_M or evidence.sigma_rad > LOST_RAD:
        state, reason = _say_vague(evidence.light)
        return state, why if state is State.LOST and why is Reason.PAUSED else reason
    if (evidence.light is not None and evidence.light.lost) or _contradicted(memory, evidence):
        return State.DEGRADED, Reason.LIGHT_DISAGREES
    return State.DEGRADED, why


def _why_lost(memory: Memory, why: Reason) -> Reason:
    """Reason of a pose that was lost before: the earlier one, or the pause, which has to end."""
    if why is Reason.PAUSED:
        return why
    return memory.reason if memory.state is State.LOST and memory.reason is not Reason.PAUSED else Reason.NO_WITNESS


def _say_without_laser(memory: Memory, evidence: Evidence) -> tuple[State, Reason]:
    """Part of the table for a lidar that has timed out or is not fitted: light may determine the pose."""
    light = evidence.light
    if light is not None and light.placed:
        return _say_of_light(memory, evidence, light)
    if not evidence.lidar:
        if evidence.places is not None and evidence.places > 1:
            return State.AMBIGUOUS, Reason.SEVERAL_PLACES
        searching = light is not None and light.alive
        return (State.RELOCATING, Reason.UNPLACED) if searching else (State.LOST, Reason.LIGHT_SILENT)
    if evidence.silence is None and not evidence.unreachable:
        return State.STARTING, Reason.OPENING_LIDAR
    return State.NO_LIDAR, _lidar_gone(evidence)


def _lidar_gone(evidence: Evidence) -> Reason:
    return Reason.LIDAR_UNREACHABLE if evidence.unreachable else Reason.LIDAR_SILENT


def _say_of_light(memory: Memory, evidence: Evidence, light: Light) -> tuple[State, Reason]:
    """Part of the table for a pose from light and odometry without a lidar."""
    if evidence.sigma_m > LOST_M or evidence.sigma_rad > LOST_RAD:
        return _say_vague(light)
    if light.lost or _contradicted(memory, evidence):
        return State.RELOCATING, Reason.LIGHT_LOST
    dark = evidence.t_mono - (memory.lit_last or 0.0)
    if dark > HELD_S and not evidence.odometry:
        return State.LOST, Reason.NO_WITNESS
    if evidence.lidar:
        return State.DEGRADED, _lidar_gone(evidence)
    missing = _missing(memory, evidence)
    if missing is not None:
        return State.DEGRADED, missing
    if evidence.sigma_m > VAGUE_M or evidence.sigma_rad > VAGUE_RAD or not all(memory.known):
        return State.DEGRADED, Reason.UNCERTAIN
    proof = RELOCATED_PROOF_S if memory.doubt else PROOF_S
    proved = memory.lit_since is not None and evidence.t_mono - memory.lit_since >= proof
    if proved and (memory.state is State.TRACKING or _together(memory, evidence)):
        return State.TRACKING, Reason.NONE
    return State.DEGRADED, Reason.CONFIRMING


def _say_of_pose(memory: Memory, evidence: Evidence) -> tuple[State, Reason]:
    """Part of the table for a pose from the lidar: lost, degraded, unconfirmed or good.

    Odometry carries a pose that no scan confirms: its covariance grows, but it is not lost.
    """
    if evidence.sigma_m > LOST_M or evidence.sigma_rad > LOST_RAD:
        state, reason = _say_vague(evidence.light)
        return (State.DEGRADED, reason) if evidence.odometry and state is State.LOST else (state, reason)
    if evidence.light is not None and evidence.light.lost:
        return State.RELOCATING if memory.failed else State.DEGRADED, Reason.LIGHT_LOST
    if memory.failed >= FAILED_SCANS:
        lit = evidence.light is not None and evidence.light.used and evidence.light.placed
        if not (evidence.odometry or lit) and evidence.t_mono - (memory.good_last or 0.0) > HELD_S:
            return State.LOST, Reason.NO_WITNESS
        return State.DEGRADED, Reason.MATCH_FAILED
    if _contradicted(memory, evidence):
        return State.DEGRADED, Reason.LIGHT_DISAGREES
    if not all(memory.known) and (memory.good >= AXIS_FOUND_SCANS or memory.state in HELD):
        return State.DEGRADED, Reason.UNCERTAIN if evidence.guessed else Reason.AXIS_UNKNOWN
    if disagreed(memory, evidence):
        return State.DEGRADED, Reason.WITNESSES_DISAGREE
    missing = _missing(memory, evidence)
    if missing is not None:
        return State.DEGRADED, missing
    if evidence.sigma_m > VAGUE_M or evidence.sigma_rad > VAGUE_RAD:
        return State.DEGRADED, Reason.UNCERTAIN
    if evidence.light is not None and not evidence.light.placed:
        return State.MAPPING, Reason.UNPLACED
    if memory.state is State.TRACKING:
        return State.TRACKING, Reason.NONE
    if _together(memory, evidence) and (_proved(memory, evidence) or _agreed(memory, evidence)):
        return State.TRACKING, Reason.NONE
    return (State.DEGRADED, Reason.CONFIRMING) if memory.state is State.DEGRADED else (State.MAPPING, Reason.UNPROVED)


def _say_vague(light: Light | None) -> tuple[State, Reason]:
    """State of a pose with a sigma above its threshold: lost, unless light is about to find it."""
    if light is not None and light.alive and light.placed and light.agrees:
        return State.RELOCATING, Reason.UNPLACED
    return State.LOST, Reason.UNCERTAIN


def _missing(memory: Memory, evidence: Evidence) -> Reason | None:
    """Reason for the first configured input that has timed out; None if all are available."""
    light = evidence.light
    if light is not None and not light.alive:
        return Reason.LIGHT_SILENT
    if evidence.odometry is False:
        return Reason.ODOMETRY_SILENT
    dark = memory.lit_last is not None and evidence.t_mono - memory.lit_last > DARK_S
    return Reason.LIGHT_DARK if light is not None and light.placed and dark else None


def disagreed(memory: Memory, evidence: Evidence) -> bool:
    """Whether odometry and lidar have contradicted each other for a while."""
    return memory.disagree_since is not None and evidence.t_mono - memory.disagree_since >= DISAGREE_S


def _contradicted(memory: Memory, evidence: Evidence) -> bool:
    if evidence.light is not None and evidence.light.elsewhere:
        return True
    return memory.odd_since is not None and evidence.t_mono - memory.odd_since >= CONTRADICTED_S


def _together(memory: Memory, evidence: Evidence) -> bool:
    """Whether pose and light have agreed for long enough, or TRACKING was reached at this position before."""
    return memory.tracked or memory.apart_last is None or evidence.t_mono - memory.apart_last >= CLEAN_S


def _clean(memory: Memory, evidence: Evidence) -> bool:
    """Whether consecutive good scans determine every axis for long enough not to flicker."""
    return memory.good >= PROOF_SCANS and all(memory.known) and evidence.t_mono - memory.known_since >= CLEAN_S


def _proved(memory: Memory, evidence: Evidence) -> bool:
    """Whether the lidar is confirmed by itself."""
    seconds = RELOCATED_PROOF_S if memory.doubt else PROOF_S
    return _clean(memory, evidence) and evidence.t_mono - memory.good_since >= seconds


def _agreed(memory: Memory, evidence: Evidence) -> bool:
    """Whether two solutions agree on the motion or the pose. Motion confirms nothing while the position is in doubt.

    A confirmed pose from before a gap counts as one of them, if the pose is found again there.
    """
    light = evidence.light
    if memory.recalled and not memory.doubt and all(memory.known):
        return memory.good >= AXIS_FOUND_SCANS and evidence.t_mono - memory.known_since >= RECALLED_S
    if light is not None and light.used and light.agrees and not light.moved:
        proof = RELOCATED_PROOF_S if memory.doubt else CLEAN_S
        if memory.lit_since is not None and evidence.t_mono - memory.lit_since >= proof:
            return _clean(memory, evidence)
    return _clean(memory, evidence) and evidence.agree is True and not memory.doubt
