"""What is said about the pose: one pure state machine, fed once per cycle with evidence.

The rule it keeps: TRACKING is only said when two witnesses agree (light and laser about the place, wheel odometry and
laser about the motion of the last seconds) or when one has proved itself (matches that are good, small and know every
axis, for a while; light that goes on fitting the place). It is never said of a place that light contradicts.
Every other state comes with a reason, and a reason comes with a remedy. Bad news counts fast, good news slowly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Final

from daemon.publish.snapshot import State

SILENT_PERIODS: Final = 3.0
"""Scan periods without a valid scan after which the lidar is said to be gone."""
PROOF_S: Final = 2.0
PROOF_SCANS: Final = 10
"""A witness has proved itself after this many good scans in a row that span at least this time."""
RELOCATED_PROOF_S: Final = 5.0
"""The same after the pose was lost: the right place has to be told from a similar one."""
FAILED_SCANS: Final = 3
"""Matches in a row that may fail before it is said; one bad scan among people is no news."""
AXIS_LOST_SCANS: Final = 3
AXIS_LOST_S: Final = 0.3
AXIS_FOUND_SCANS: Final = 5
"""Scans in a row, over at least this time, after which an axis changes between known and unknown: what moved in a
tenth of a second is millimetres, and says nothing about the pose."""
CLEAN_S: Final = 1.0
"""Every axis has to be known for this long before TRACKING is said (again)."""
DISAGREE_S: Final = 1.0
"""Disagreement of the witnesses has to last this long: stamps jitter."""
HELD_S: Final = 1.0
"""Without odometry a pose is held by its last velocity for this long after the last good match, then it is lost."""
LOST_M: Final = 1.0
LOST_RAD: Final = 0.26
"""One-sigma uncertainty beyond which a pose is not worth using."""
DARK_S: Final = 5.0
"""Light that tells nothing for this long is a witness that is missing: the way between two lamps is shorter."""
CONTRADICTED_S: Final = 0.3
"""Light has to contradict the place for this long: an epoch may be spoiled by who walks by."""
VAGUE_M: Final = 0.15
VAGUE_RAD: Final = 0.04
"""One-sigma uncertainty beyond which TRACKING is not said."""


HELD: Final = (State.TRACKING, State.DEGRADED)
"""States in which a proved pose is held."""


class Reason(IntEnum):
    """Why the state is what it is. Numbers are part of the contract: never renumber."""

    NONE = 0
    WARMING_UP = 1
    OPENING_LIDAR = 2
    LIDAR_UNREACHABLE = 3
    LIDAR_SILENT = 4
    UNPROVED = 5
    AXIS_UNKNOWN = 6
    MATCH_FAILED = 7
    WITNESSES_DISAGREE = 8
    ODOMETRY_SILENT = 9
    UNCERTAIN = 10
    NO_WITNESS = 11
    SEVERAL_PLACES = 12
    SEARCHING = 13
    CONFIRMING = 14
    LIGHT_SILENT = 15
    LIGHT_DARK = 16
    LIGHT_DISAGREES = 17
    LIGHT_LOST = 18
    UNPLACED = 19


REASONS: Final[dict[Reason, tuple[str, str]]] = {
    Reason.NONE: ("the pose is confirmed", ""),
    Reason.WARMING_UP: ("starting up", "wait; the first start ever compiles for up to a minute"),
    Reason.OPENING_LIDAR: ("the lidar is being opened", "wait a few seconds"),
    Reason.LIDAR_UNREACHABLE: ("the lidar cannot be opened", "read the log, then run `lumiloop probe`"),
    Reason.LIDAR_SILENT: ("no valid scan for three scan periods", "check the lidar's power and cable"),
    Reason.UNPROVED: ("the pose follows the laser, nothing has confirmed it yet", "wait, or drive a metre or two"),
    Reason.AXIS_UNKNOWN: ("the surroundings do not fix every axis of the pose", "read the known-axis bits"),
    Reason.MATCH_FAILED: ("scans do not fit the map, the pose is held", "is the lidar covered, lifted or crowded in?"),
    Reason.WITNESSES_DISAGREE: (
        "odometry and laser disagree about the motion",
        "wheel slip; if it lasts, check odometry scale and lidar mount",
    ),
    Reason.ODOMETRY_SILENT: ("odometry is configured and does not arrive", "check its sender and `odometry.port`"),
    Reason.UNCERTAIN: (
        "the robot may have moved further than anything has witnessed",
        "set the pose, or drive to where it was known; wheel odometry bridges such gaps",
    ),
    Reason.NO_WITNESS: ("nothing has confirmed the pose for too long", "set the pose, or drive to where it was known"),
    Reason.SEVERAL_PLACES: ("several places fit", "drive on until one is left"),
    Reason.SEARCHING: ("looking for the place in the map", "wait"),
    Reason.CONFIRMING: ("scans fit again; being confirmed", "wait a few seconds"),
    Reason.LIGHT_SILENT: (
        "the photodiode is configured and its samples do not arrive",
        "check its converter's power and bus; read the fault",
    ),
    Reason.LIGHT_DARK: (
        "no lamp can be used",
        "are the lamps on, is the photodiode covered, is this part of the building surveyed?",
    ),
    Reason.LIGHT_DISAGREES: (
        "light and pose contradict each other about the place",
        "wait some seconds; if it lasts or comes again: lamps moved, a wrong survey, or the laser slipped",
    ),
    Reason.LIGHT_LOST: (
        "what is received does not fit the place, it is being found anew from the lamps",
        "drive a metre or two; if it lasts, check the survey",
    ),
    Reason.UNPLACED: (
        "where the robot stands and looks in the survey is not known yet",
        "drive a metre or two in view of three lamps, or set the pose",
    ),
}
"""For every reason what it means and what a person can do."""


@dataclass(frozen=True, slots=True)
class Match:
    """What one scan's match says, already judged by the cycle.

    Attributes:
        good: it is a result and enough of the scan took part.
        known: (x, y, yaw) whether the match fixed the axis.
    """

    good: bool
    known: tuple[bool, bool, bool]


@dataclass(frozen=True, slots=True)
class Light:
    """What light says, already judged by the cycle.

    Attributes:
        alive: samples arrive. used: lamps are received and used, and the place and heading they tell are good.
        placed: it has been told by light where the map lies.
        lost: what is received contradicts the place that light itself had told.
        agrees: whether the light's place and the pose are the same within what both may be wrong; None: cannot be said.
        moved: in this cycle the pose was moved to where light says, after the two had contradicted each other.
        known: (x, y, yaw) whether the pose knows the axis, with or without a laser.
    """

    alive: bool
    used: bool = False
    placed: bool = False
    lost: bool = False
    agrees: bool | None = None
    moved: bool = False
    known: tuple[bool, bool, bool] = (False, False, False)


@dataclass(frozen=True, slots=True)
class Evidence:
    """What one cycle knows. Times in seconds of ``t_mono``.

    Attributes:
        t_mono: now.
        silence: scan periods since the last valid scan; None before the first.
        unreachable: the driver has backed off, and said why, since the last valid scan.
        match: of the scan of this cycle; None without a scan or before there is a map to match against.
        mapped: there is something to match against.
        sigma_m, sigma_rad: one-sigma uncertainty (larger axis; heading) gained by motion that nothing has witnessed.
        guessed: the map itself was laid upon a guess; the place in it stays one until something else tells it.
        odometry: whether it is arriving; None where none is configured.
        agree: whether wheels and laser told the same motion lately; None where that cannot be said.
        places: how many places fit while the place is looked for (0: none yet); None: not looking.
        ordered: a person has set the pose or reset the map in this cycle.
        lidar: there is one. light: None where no photodiode is configured.
    """

    t_mono: float
    silence: float | None = None
    unreachable: bool = False
    match: Match | None = None
    mapped: bool = False
    sigma_m: float = 0.0
    sigma_rad: float = 0.0
    guessed: bool = False
    odometry: bool | None = None
    agree: bool | None = None
    places: int | None = None
    ordered: bool = False
    lidar: bool = True
    light: Light | None = None


Streak = tuple[int, float]
"""How many in a row, and when it began."""


@dataclass(frozen=True, slots=True)
class Memory:
    """What the machine remembers between cycles; start with ``Memory()``.

    Attributes:
        good, good_since: good scans in a row and when the first of them was. failed: failed scans in a row.
        good_last: when a match was last good.
        axes: per axis, scans in a row that say otherwise than what is shown, and when the first of them did.
        known: the axes as shown. known_since: when the last of them became known.
        disagree_since: None while the witnesses do not disagree.
        doubt: the place itself has to be proved again, because nothing told the motion for a while.
        lost: the pose was given up and is not confirmed yet; implies ``doubt``.
        lit_since: since when light has told the place without a pause of `DARK_S`. lit_last: when it last did.
        odd_since: since when light has contradicted the place; both None while it does not.
    """

    state: State = State.STARTING
    reason: Reason = Reason.WARMING_UP
    good: int = 0
    good_since: float = 0.0
    good_last: float | None = None
    failed: int = 0
    axes: tuple[Streak, Streak, Streak] = ((0, 0.0), (0, 0.0), (0, 0.0))
    known: tuple[bool, bool, bool] = (False, False, False)
    known_since: float = 0.0
    disagree_since: float | None = None
    doubt: bool = False
    lost: bool = False
    lit_since: float | None = None
    lit_last: float | None = None
    odd_since: float | None = None


def judge(memory: Memory, evidence: Evidence) -> Memory:
    """Take in one cycle's evidence; ``state``, ``reason`` and ``known`` of the answer are what is published."""
    if evidence.ordered:
        memory = Memory(memory.state, memory.reason)
    memory = _remember(memory, evidence)
    state, reason = _say(memory, evidence)
    lost = state is State.LOST or (memory.lost and state in (State.RELOCATING, State.AMBIGUOUS, State.NO_LIDAR))
    doubt = lost or evidence.places is not None or (memory.doubt and state is not State.TRACKING)
    return replace(memory, state=state, reason=reason, lost=lost, doubt=doubt)


def _say(memory: Memory, evidence: Evidence) -> tuple[State, Reason]:
    """The table, gravest first."""
    if evidence.silence is None or evidence.silence >= SILENT_PERIODS:
        return _say_without_laser(memory, evidence)
    if evidence.places is not None:
        if evidence.places > 1:
            return State.AMBIGUOUS, Reason.SEVERAL_PLACES
        return State.RELOCATING, Reason.CONFIRMING if evidence.places else Reason.SEARCHING
    if not evidence.mapped:
        return State.MAPPING, Reason.UNPROVED
    if memory.lost and not _proved(memory, evidence):
        if evidence.guessed:
            return State.LOST, Reason.UNCERTAIN
        fits = memory.good >= AXIS_FOUND_SCANS
        return (State.RELOCATING, Reason.CONFIRMING) if fits else (State.LOST, Reason.NO_WITNESS)
    return _say_of_pose(memory, evidence)


def _say_without_laser(memory: Memory, evidence: Evidence) -> tuple[State, Reason]:
    """The part of the table for a laser that is silent or not there: light may hold the pose."""
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
    """The part of the table for a pose that light and odometry hold without a laser."""
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
    if memory.lit_since is not None and evidence.t_mono - memory.lit_since >= proof:
        return State.TRACKING, Reason.NONE
    return State.DEGRADED, Reason.CONFIRMING


def _say_of_pose(memory: Memory, evidence: Evidence) -> tuple[State, Reason]:
    """The part of the table for a pose that is held: is it lost, degraded, unproved or good."""
    if evidence.sigma_m > LOST_M or evidence.sigma_rad > LOST_RAD:
        return _say_vague(evidence.light)
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
    if memory.disagree_since is not None and evidence.t_mono - memory.disagree_since >= DISAGREE_S:
        return State.DEGRADED, Reason.WITNESSES_DISAGREE
    missing = _missing(memory, evidence)
    if missing is not None:
        return State.DEGRADED, missing
    if evidence.sigma_m > VAGUE_M or evidence.sigma_rad > VAGUE_RAD:
        return State.DEGRADED, Reason.UNCERTAIN
    if evidence.light is not None and not evidence.light.placed:
        return State.MAPPING, Reason.UNPLACED
    if memory.state is State.TRACKING or _proved(memory, evidence) or _agreed(memory, evidence):
        return State.TRACKING, Reason.NONE
    return (State.DEGRADED, Reason.CONFIRMING) if memory.state is State.DEGRADED else (State.MAPPING, Reason.UNPROVED)


def _say_vague(light: Light | None) -> tuple[State, Reason]:
    """A pose too uncertain to be used: lost, unless light is just finding it."""
    if light is not None and light.alive and light.placed and light.agrees:
        return State.RELOCATING, Reason.UNPLACED
    return State.LOST, Reason.UNCERTAIN


def _missing(memory: Memory, evidence: Evidence) -> Reason | None:
    """Which configured witness has fallen silent, if any."""
    light = evidence.light
    if light is not None and not light.alive:
        return Reason.LIGHT_SILENT
    if evidence.odometry is False:
        return Reason.ODOMETRY_SILENT
    dark = memory.lit_last is not None and evidence.t_mono - memory.lit_last > DARK_S
    return Reason.LIGHT_DARK if light is not None and light.placed and dark else None


def _contradicted(memory: Memory, evidence: Evidence) -> bool:
    return memory.odd_since is not None and evidence.t_mono - memory.odd_since >= CONTRADICTED_S


def _clean(memory: Memory, evidence: Evidence) -> bool:
    """Good scans in a row that know every axis, for long enough not to flicker."""
    return memory.good >= PROOF_SCANS and all(memory.known) and evidence.t_mono - memory.known_since >= CLEAN_S


def _proved(memory: Memory, evidence: Evidence) -> bool:
    """Whether the laser has proved itself."""
    seconds = RELOCATED_PROOF_S if memory.doubt else PROOF_S
    return _clean(memory, evidence) and evidence.t_mono - memory.good_since >= seconds


def _agreed(memory: Memory, evidence: Evidence) -> bool:
    """Whether two witnesses tell the same motion, or place; the motion says nothing about a place in doubt."""
    light = evidence.light
    if light is not None and light.used and light.agrees and not light.moved:
        proof = RELOCATED_PROOF_S if memory.doubt else CLEAN_S
        if memory.lit_since is not None and evidence.t_mono - memory.lit_since >= proof:
            return _clean(memory, evidence)
    return _clean(memory, evidence) and evidence.agree is True and not memory.doubt


def _remember(memory: Memory, evidence: Evidence) -> Memory:
    now = evidence.t_mono
    memory = replace(memory, odd_since=None) if evidence.light is None else _take_light(memory, evidence.light, now)
    if not evidence.lidar or (evidence.silence is not None and evidence.silence >= SILENT_PERIODS):
        return _forget_laser(memory, evidence)
    since = memory.disagree_since if memory.disagree_since is not None else now
    memory = replace(memory, disagree_since=since if evidence.agree is False else None)
    if evidence.places is not None:
        memory = replace(memory, good=0)  # what fits the surroundings proves nothing of the place in the map
    if evidence.match is None:
        return memory
    return _take_good(memory, evidence.match, now) if evidence.match.good else _take_failed(memory)


def _forget_laser(memory: Memory, evidence: Evidence) -> Memory:
    """What is left of the memory while the laser is silent; a pose that nothing carried on is in doubt."""
    now, light = evidence.t_mono, evidence.light
    carried = evidence.odometry or (light is not None and light.used)
    blind = not carried and memory.good_last is not None and now - memory.good_last > HELD_S
    known = light.known if light is not None and light.placed else (False, False, False)
    return replace(
        Memory(memory.state, memory.reason, lost=memory.lost, doubt=memory.doubt or blind),
        good_last=memory.good_last,
        known=known,
        lit_since=memory.lit_since,
        lit_last=memory.lit_last,
        odd_since=memory.odd_since,
    )


def _take_light(memory: Memory, light: Light, now: float) -> Memory:
    """Remember since when light has told the place, and since when it has contradicted the pose."""
    odd = light.agrees is False
    memory = replace(memory, odd_since=(now if memory.odd_since is None else memory.odd_since) if odd else None)
    if light.moved or light.lost:
        memory = replace(memory, doubt=True, lit_since=None, good=0)
    if light.used and light.placed and not odd:
        begun = memory.lit_since is None or now - (memory.lit_last or now) > DARK_S
        return replace(memory, lit_since=now if begun else memory.lit_since, lit_last=now)
    return memory


def _take_failed(memory: Memory) -> Memory:
    failed = memory.failed + 1
    known = memory.known if failed < FAILED_SCANS else (False, False, False)
    return replace(memory, good=0, failed=failed, known=known)


def _take_good(memory: Memory, match: Match, now: float) -> Memory:
    x, y, yaw = (_axis(*axis, now) for axis in zip(memory.known, memory.axes, match.known, strict=True))
    known = (x[0], y[0], yaw[0])
    return replace(
        memory,
        good=memory.good + 1,
        good_since=memory.good_since if memory.good else now,
        good_last=now,
        failed=0,
        known=known,
        axes=(x[1], y[1], yaw[1]),
        known_since=memory.known_since if all(memory.known) or not all(known) else now,
    )


def _axis(shown: bool, streak: Streak, seen: bool, now: float) -> tuple[bool, Streak]:
    """One axis' hysteresis: what is shown, and the streak of scans that say otherwise."""
    if seen == shown:
        return shown, (0, 0.0)
    count, since = streak[0] + 1, streak[1] if streak[0] else now
    changed = count >= AXIS_FOUND_SCANS if seen else count >= AXIS_LOST_SCANS and now - since >= AXIS_LOST_S
    return (seen, (0, 0.0)) if changed else (shown, (count, since))
