"""What the state machine remembers from cycle to cycle. Bad news counts fast, good news slowly."""

from __future__ import annotations

import math
from typing import Final

import msgspec
from msgspec.structs import replace

from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS, Evidence, Light, Match
from daemon.snapshot import State

FAILED_SCANS: Final = 3
"""Matches in a row that may fail before it is said; one bad scan among people is no news."""
AXIS_LOST_SCANS: Final = 3
AXIS_LOST_S: Final = 0.3
AXIS_FOUND_SCANS: Final = 5
"""Scans in a row, over at least this time, after which an axis changes between known and unknown: what moved in a
tenth of a second is millimetres, and says nothing about the pose."""
HELD_S: Final = 1.0
"""Without odometry a pose is held by its last velocity for this long after the last good match, then it is lost."""
DARK_S: Final = 5.0
"""Light that tells nothing for this long is a witness that is missing: the way between two lamps is shorter."""


BLIND_S: Final = 60.0
"""A robot that nothing watches for longer may have been carried off, and put down where it looks alike."""
THERE_M: Final = 0.15
THERE_RAD: Final = 0.06
"""A pose that was proved is found again where it was taken to be: the first match moves it by no more than this."""


AGAIN_S: Final = 3.0
"""A laser that falls silent again so soon after it was said to be back is one that comes and goes."""
STEADY_S: Final = 0.8
"""It is said to be back when no silence has come for this long: a pose that was sure is proved by then."""
OFTEN: Final = 6
"""So many times in a row are no bad moment but a loose plug."""
STEADIEST_S: Final = 3.2
"""Such a laser is said to be back only then; longer than `AGAIN_S`: gaps at a steady pace end with one word."""


Streak = tuple[int, float]
"""How many in a row, and when it began."""


class Memory(msgspec.Struct, frozen=True):
    """What the machine remembers between cycles; start with ``Memory()``. A struct: every cycle makes new ones.

    Attributes:
        good, good_since: good scans in a row and when the first of them was. failed: failed scans in a row.
        good_last: when a match was last good.
        axes: per axis, scans in a row that say otherwise than what is shown, and when the first of them did.
        known: the axes as shown. known_since: when the last of them became known.
        disagree_since: None while the witnesses do not disagree.
        doubt: the place itself has to be proved again, because nothing told the motion for a while.
        lost: the pose was given up and is not confirmed yet; implies ``doubt``.
        sure: the pose was proved when the laser fell silent. recalled: the laser is back, and has found it there.
        lit_since: since when light has told the place without a pause of `DARK_S`. lit_last: when it last did.
        odd_since: since when light has contradicted the place; both None while it does not.
        tracked: TRACKING has been said of this place before. apart_last: when pose and light last were apart.
        led: light has moved the pose, and has not been sure of the place since.
        gone: the laser is silent. back: when it last came back, None: it has not been away. fitful: how often in a row
            it has fallen silent again soon after it was said to be back.
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
    sure: bool = False
    recalled: bool = False
    lit_since: float | None = None
    lit_last: float | None = None
    odd_since: float | None = None
    tracked: bool = False
    apart_last: float | None = None
    led: bool = False
    gone: bool = False
    back: float | None = None
    fitful: int = 0


def remember(memory: Memory, evidence: Evidence) -> Memory:
    """Take in one cycle's evidence."""
    now = evidence.t_mono
    memory = _odd(memory, None) if evidence.light is None else _take_light(memory, evidence.light, now)
    silent = evidence.silence is not None and evidence.silence >= SILENT_PERIODS
    if silent is not memory.gone:
        memory = _gone(memory, now) if silent else replace(memory, gone=False, back=now)
    if not evidence.lidar or silent or evidence.unused is not None:
        return _forget_laser(memory, evidence)
    since = memory.disagree_since if memory.disagree_since is not None else now
    since_or_none = since if evidence.agree is False else None
    if since_or_none is not memory.disagree_since:
        memory = replace(memory, disagree_since=since_or_none)
    if evidence.places is not None:
        # what fits the surroundings proves nothing of the place in the map
        memory = replace(memory, good=0, sure=False, recalled=False)
    if evidence.recalled:
        memory = replace(memory, recalled=True, doubt=False)
    if evidence.match is None:
        return memory
    return _take_good(memory, evidence.match, now) if evidence.match.good else _take_failed(memory)


def steady(memory: Memory, now: float) -> bool:
    """Whether the laser can be said to be there: one that comes and goes must not take what is said along."""
    if not memory.fitful:
        return True
    return not memory.gone and memory.back is not None and now - memory.back >= _hold(memory)


def _hold(memory: Memory) -> float:
    """Seconds without a silence after which the laser is said to be back."""
    if not memory.fitful:
        return 0.0
    return STEADY_S if memory.fitful < OFTEN else STEADIEST_S


def _gone(memory: Memory, now: float) -> Memory:
    """The laser has fallen silent."""
    there = math.inf if memory.back is None else now - memory.back - _hold(memory)
    if there >= AGAIN_S:
        return replace(memory, gone=True, fitful=0)
    said = there >= 0.0  # else nobody has heard that it was back
    return replace(memory, gone=True, fitful=memory.fitful + said)


def _forget_laser(memory: Memory, evidence: Evidence) -> Memory:
    """What is left of the memory while the laser is silent or not used; a pose that nothing carried on is in doubt."""
    now, light = evidence.t_mono, evidence.light
    carried = evidence.odometry or (light is not None and light.used)
    blind = not carried and memory.good_last is not None and now - memory.good_last > HELD_S
    known = light.known if light is not None and light.placed else (False, False, False)
    return replace(
        Memory(memory.state, memory.reason, lost=memory.lost, doubt=memory.doubt or blind),
        good_last=memory.good_last,
        sure=_sure(memory, carried or now - (memory.good_last or now) < BLIND_S),
        known=known,
        lit_since=memory.lit_since,
        lit_last=memory.lit_last,
        odd_since=memory.odd_since,
        tracked=memory.tracked,
        apart_last=memory.apart_last,
        led=memory.led,
        gone=memory.gone,
        back=memory.back,
        fitful=memory.fitful,
    )


def _sure(memory: Memory, watched: bool) -> bool:
    """Whether the pose was proved when the laser fell silent, or left out, and nobody can have carried it off since."""
    held = memory.state is State.TRACKING or (memory.state is State.DEGRADED and memory.good > 0 and all(memory.known))
    proved = held and not (memory.doubt or memory.lost)
    return (proved or memory.sure or memory.recalled) and watched


def _take_light(memory: Memory, light: Light, now: float) -> Memory:
    """Remember since when light has told the place, and since when it has contradicted the pose."""
    odd = light.agrees is False
    memory = _odd(memory, (now if memory.odd_since is None else memory.odd_since) if odd else None)
    if light.apart:
        memory = replace(memory, apart_last=now)
    if light.moved or light.lost:
        led = memory.led or light.moved
        memory = replace(memory, doubt=True, lit_since=None, good=0, sure=False, recalled=False, led=led)
    if light.used and light.placed and not odd:
        begun = memory.lit_since is None or now - (memory.lit_last or now) > DARK_S
        led = memory.led and light.moved
        return replace(memory, lit_since=now if begun else memory.lit_since, lit_last=now, led=led)
    held = memory.state is State.TRACKING and not (memory.doubt or memory.led)
    if light.fits and light.placed and not odd and held:
        return replace(memory, lit_last=now)  # a second witness finds the pose that is held: that is not dark
    return memory


def _odd(memory: Memory, since: float | None) -> Memory:
    """Since when light has contradicted the pose; making a new memory costs more than looking whether it is one."""
    return memory if since is memory.odd_since else replace(memory, odd_since=since)


def _take_failed(memory: Memory) -> Memory:
    failed = memory.failed + 1
    known = memory.known if failed < FAILED_SCANS else (False, False, False)
    gone = failed >= FAILED_SCANS
    return replace(
        memory,
        good=0,
        failed=failed,
        known=known,
        sure=memory.sure and not gone,
        recalled=memory.recalled and not gone,
    )


def _take_good(memory: Memory, match: Match, now: float) -> Memory:
    x, y, yaw = (_axis(*axis, now) for axis in zip(memory.known, memory.axes, match.known, strict=True))
    known = (x[0], y[0], yaw[0])
    there = memory.sure and match.off_m <= THERE_M and match.off_rad <= THERE_RAD
    return replace(
        memory,
        sure=False,
        recalled=memory.recalled or there,
        doubt=memory.doubt and not there,
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
