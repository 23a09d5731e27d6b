"""Memory of the state machine between cycles: hysteresis counters and times. It degrades fast and recovers slowly."""

from __future__ import annotations

import math
from typing import Final

import msgspec
from msgspec.structs import replace

from daemon.health.reasons import Reason
from daemon.integrity.evidence import SILENT_PERIODS, Evidence, Light, Match
from daemon.snapshot import State

FAILED_SCANS: Final = 3
"""Consecutive failed matches that are tolerated: one bad scan among people is normal."""
AXIS_LOST_SCANS: Final = 3
AXIS_LOST_S: Final = 0.3
AXIS_FOUND_SCANS: Final = 5
"""Consecutive scans, over at least this time, after which an axis changes between known and unknown. Motion within a
tenth of a second is millimetres and does not affect the pose."""
HELD_S: Final = 1.0
"""Time in s without odometry for which the velocity predicts the pose after the last good match; then it is lost."""
DARK_S: Final = 5.0
"""Time in s after which a missing light solution counts: the way between two lamps takes less."""


BLIND_S: Final = 60.0
"""Time in s without measurements after which the robot may have been kidnapped to a place of similar appearance."""
THERE_M: Final = 0.15
THERE_RAD: Final = 0.06
"""Largest correction by the first match at which a confirmed pose counts as found again."""


AGAIN_S: Final = 3.0
"""Time in s within which the next timeout of the lidar after its recovery counts as intermittent."""
STEADY_S: Final = 0.8
"""Time in s without a timeout after which the lidar has recovered: a pose that was certain is confirmed by then."""
OFTEN: Final = 6
"""Number of intermittent timeouts in a row that indicate a loose plug."""
STEADIEST_S: Final = 3.2
"""Recovery time in s of such a lidar; longer than `AGAIN_S`, so that periodic gaps cause one report only."""


Streak = tuple[int, float]
"""Number of consecutive scans, and the time of the first."""


class Memory(msgspec.Struct, frozen=True):
    """State of the state machine between cycles; start with ``Memory()``. A struct: every cycle makes new ones.

    Attributes:
        good, good_since: consecutive good scans and the time of the first. failed: consecutive failed scans.
        good_last: time of the latest good match.
        axes: per axis, consecutive scans that differ from the shown value, and the time of the first.
        known: the axes as published. known_since: when the last of them became known.
        disagree_since: None while the solutions do not disagree.
        doubt: the position needs confirmation again, because no measurement determined the motion for a while.
        lost: the pose was abandoned and is not confirmed yet; implies ``doubt``.
        sure: the pose was confirmed when the lidar timed out. recalled: the lidar has recovered and found it there.
        lit_since: start of the present light solution without a gap of `DARK_S`. lit_last: its latest time.
        odd_since: start of the present contradiction by light; None while there is none.
        tracked: TRACKING was reached at this position before. apart_last: latest time when pose and light disagreed.
        led: light has moved the pose, and has not confirmed it since.
        gone: the lidar has timed out. back: its latest recovery, None: it was never away. fitful: number of consecutive
            timeouts soon after a reported recovery.
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
    """Update the memory with one cycle's evidence."""
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
        # a fit to the surroundings does not confirm the pose in the map
        memory = replace(memory, good=0, sure=False, recalled=False)
    if evidence.recalled:
        memory = replace(memory, recalled=True, doubt=False)
    if evidence.match is None:
        return memory
    return _take_good(memory, evidence.match, now) if evidence.match.good else _take_failed(memory)


def steady(memory: Memory, now: float) -> bool:
    """Whether the lidar counts as available; an intermittent one must not make the state alternate."""
    if not memory.fitful:
        return True
    return not memory.gone and memory.back is not None and now - memory.back >= _hold(memory)


def _hold(memory: Memory) -> float:
    """Time in s without a timeout after which the lidar counts as recovered."""
    if not memory.fitful:
        return 0.0
    return STEADY_S if memory.fitful < OFTEN else STEADIEST_S


def _gone(memory: Memory, now: float) -> Memory:
    """Update at a timeout of the lidar."""
    there = math.inf if memory.back is None else now - memory.back - _hold(memory)
    if there >= AGAIN_S:
        return replace(memory, gone=True, fitful=0)
    said = there >= 0.0  # otherwise its recovery was never reported
    return replace(memory, gone=True, fitful=memory.fitful + said)


def _forget_laser(memory: Memory, evidence: Evidence) -> Memory:
    """Memory while the lidar is timed out or not used; a pose without any other motion source is in doubt."""
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
    """Whether the pose was confirmed when the lidar timed out or was skipped, and kidnapping since is excluded."""
    held = memory.state is State.TRACKING or (memory.state is State.DEGRADED and memory.good > 0 and all(memory.known))
    proved = held and not (memory.doubt or memory.lost)
    return (proved or memory.sure or memory.recalled) and watched


def _take_light(memory: Memory, light: Light, now: float) -> Memory:
    """Update the times since which light determines the pose and since which it contradicts the pose."""
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
        return replace(memory, lit_last=now)  # a second solution confirms the pose, so light counts as present
    return memory


def _odd(memory: Memory, since: float | None) -> Memory:
    """Set the start of the contradiction by light; a new struct costs more than the comparison before it."""
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
    """Hysteresis of one axis: the shown value, and the streak of scans that differ from it."""
    if seen == shown:
        return shown, (0, 0.0)
    count, since = streak[0] + 1, streak[1] if streak[0] else now
    changed = count >= AXIS_FOUND_SCANS if seen else count >= AXIS_LOST_SCANS and now - since >= AXIS_LOST_S
    return (seen, (0, 0.0)) if changed else (shown, (count, since))
