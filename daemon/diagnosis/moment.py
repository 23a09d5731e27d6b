"""A replayed cycle with what was published at that time, and the choice of the cycle for a given time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Final, NamedTuple

from daemon.health.reasons import Reason
from daemon.integrity.motion_consistency import MotionComparison as Wheels
from daemon.recording.recorder import CycleEntry
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import CycleRecord
from daemon.snapshot import Snapshot, State
from estimator import StepResult

SECOND_S: Final = 1.0
"""Duration of a time without a fraction, as in the journal, s."""
LATE_S: Final = 0.15
"""Longest time from a fault in the journal, written at a heartbeat, to its publication, s. With a slow lidar it is
published with the next cycle, which may begin up to :data:`SECOND_S` later."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One replayed cycle, with what was published at that time.

    Attributes:
        utc: its start, s, to the microsecond, so that comparisons agree with the printed times. state: as published.
        snapshot, result: of the replay. scan: number of the consumed scan. fresh: whether the result is of this cycle.
        wheels: motion by odometry and by lidar over the last two seconds, None if they cannot be compared.
        dropped: scans that were not consumed.
        told: number of the published reason, None in older recordings without reason and faults.
        faults: numbers of the published faults, gravest first.
    """

    utc: float
    state: State
    snapshot: Snapshot
    result: StepResult | None
    scan: int | None
    fresh: bool
    wheels: Wheels | None
    dropped: int
    orders: tuple[str, ...]
    told: int | None = None
    faults: tuple[int, ...] = ()

    @property
    def reason(self) -> Reason:
        """Reason of the state: the published one if it is known, else that of the replay."""
        known = self.told if self.told in Reason._value2member_map_ else None
        return Reason(self.snapshot.reason if known is None else known)


def moment_of(utc_at_zero: float, entry: CycleEntry, record: CycleRecord, cycle: Cycle) -> Moment:
    """Returns a cycle that has just been repeated."""
    return Moment(
        utc=round(utc_at_zero + record.t_mono, 6),
        state=State(entry.state),
        snapshot=record.snapshot,
        result=record.result,
        scan=record.scan,
        fresh=record.limits is not None,
        wheels=cycle.observer.motion_consistency.compared(),
        dropped=len(record.dropped),
        orders=tuple(command.order for command in entry.commands),
        told=entry.reason,
        faults=entry.faults,
    )


class Chosen(NamedTuple):
    """The reported cycle.

    Attributes:
        cycle: its index. last: index of the last cycle whose changes are reported; equal to ``cycle`` if the time is no
            whole second. changed: index of the first change in a whole second; None without one, and for other times.
    """

    cycle: int
    last: int
    changed: int | None


def clock(utc: float, whole: bool = False) -> str:
    """Returns date, local time to the millisecond (``whole``: second), and the zone's offset; ``utc``: s."""
    local = datetime.fromtimestamp(utc, UTC).astimezone()
    fraction = "" if whole else f".{local.microsecond // 1000:03d}"
    return f"{local:%Y-%m-%d %H:%M:%S}{fraction}{local:%z}"


def of_day(utc: float) -> str:
    """Returns the local time of day to the millisecond; ``utc``: s."""
    return f"{datetime.fromtimestamp(utc, UTC).astimezone():%H:%M:%S.%f}"[:-3]


def at(told: Sequence[Moment], utc: float) -> int:
    """Returns the index of the cycle in force at an instant."""
    return max((k for k, one in enumerate(told) if one.utc <= utc), default=0)


def first_change(told: Sequence[Moment], utc: float, wide: float) -> int | None:
    """Returns the index of the first cycle in a second that changes state, reason or faults; None without one.

    Changes that are published a moment after the second count if nothing changes in it. The second lasts from ``utc``
    for ``wide``, s, which is less if only its end is recorded.
    """
    for k in range(1, _reach(told, end_of(utc, wide)) + 1):
        if told[k].utc >= utc and _key(told[k]) != _key(told[k - 1]):
            return k
    return None


def chosen(told: Sequence[Moment], utc: float, second: bool, wide: float) -> Chosen:
    """Returns the cycle for a time that lasts from ``utc`` for ``wide``, s, more than 0.

    For a whole ``second`` it is the cycle of the first change, else the first cycle. Another time may be a printed and
    truncated one: it gives the last cycle that began before the time's end.
    """
    end = end_of(utc, wide)
    if not second:
        k = _before(told, end)
        return Chosen(k, k, None)
    changed = first_change(told, utc, wide)
    first = next((k for k, one in enumerate(told) if utc <= one.utc < end), at(told, utc))
    k = first if changed is None else changed
    return Chosen(k, max(k, _reach(told, end)), changed)


def end_of(utc: float, wide: float) -> float:
    """Returns the end of a time, UTC in s, rounded like the cycles: a floating-point sum is off by parts of a us."""
    return round(utc + wide, 6)


def _before(told: Sequence[Moment], end: float) -> int:
    """Returns the index of the last cycle that began before an instant."""
    return max((k for k, one in enumerate(told) if one.utc < end), default=0)


def _reach(told: Sequence[Moment], end: float) -> int:
    """Returns the last cycle that publishes input from before ``end``: the next one to begin, unless it is far off."""
    last = _before(told, end + LATE_S)
    following = next((k for k, one in enumerate(told) if one.utc >= end), last)
    return max(last, following) if told[following].utc < end + SECOND_S else last


def _key(one: Moment) -> tuple[State, Reason, tuple[int, ...]]:
    return one.state, one.reason, one.faults


def faults_changed(before: Moment, one: Moment) -> list[tuple[str, int]]:
    """Returns the faults that appeared (``+``) and ended (``-``) between two cycles, gravest first."""
    come = [("+", fault) for fault in one.faults if fault not in before.faults]
    return come + [("-", fault) for fault in before.faults if fault not in one.faults]
