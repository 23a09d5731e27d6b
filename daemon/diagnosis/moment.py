"""A replayed cycle with what was published then, and which one is meant by a time that somebody writes."""

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
"""A time without a fraction, as the journal writes it, is of all that came in this long."""
LATE_S: Final = 0.15
"""The journal has a fault from a heartbeat; it is published within this long, or, of a slow lidar, with the next cycle,
which may begin up to :data:`SECOND_S` later."""


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """One cycle as it was replayed, with what was published then.

    Attributes:
        utc: when it began, to the microsecond, so that no boundary is judged otherwise than it is printed. state: as it
            was published then. snapshot, result: of the replay. scan: number of the scan it took. fresh: whether the
            result is of this cycle. wheels: what wheels and laser told over the last two seconds, None where that
            cannot be said. dropped: scans that were not taken.
        told: number of the reason that was published, None in a recording of before reason and faults were kept.
        faults: numbers of those that were published, gravest first.
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
        """Why the state is what it is: as it was published, where that is known, else as the replay has it."""
        known = self.told if self.told in Reason._value2member_map_ else None
        return Reason(self.snapshot.reason if known is None else known)


def moment_of(utc_at_zero: float, entry: CycleEntry, record: CycleRecord, cycle: Cycle) -> Moment:
    """A cycle that has just been repeated."""
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
    """Which cycle is told.

    Attributes:
        cycle: its index. last: that of the last one whose changes are told; of what is no whole second it is ``cycle``.
        changed: that of a whole second's first change, None where there is none, and of what is no whole second.
    """

    cycle: int
    last: int
    changed: int | None


def clock(utc: float, whole: bool = False) -> str:
    """Date, local time of day to the millisecond (``whole``: second), and the zone's offset then; ``utc``: s."""
    local = datetime.fromtimestamp(utc, UTC).astimezone()
    fraction = "" if whole else f".{local.microsecond // 1000:03d}"
    return f"{local:%Y-%m-%d %H:%M:%S}{fraction}{local:%z}"


def of_day(utc: float) -> str:
    """Local time of day to the millisecond; ``utc``: s."""
    return f"{datetime.fromtimestamp(utc, UTC).astimezone():%H:%M:%S.%f}"[:-3]


def at(told: Sequence[Moment], utc: float) -> int:
    """Index of the cycle in force at an instant."""
    return max((k for k, one in enumerate(told) if one.utc <= utc), default=0)


def first_change(told: Sequence[Moment], utc: float, wide: float) -> int | None:
    """Index of the first cycle of a second in which state, reason or faults are others than before; None: in none.

    What of it is published a moment after it counts where nothing changes in it. The second goes from ``utc`` on for
    ``wide``, s, which is less where only its end is recorded.
    """
    for k in range(1, _reach(told, end_of(utc, wide)) + 1):
        if told[k].utc >= utc and _key(told[k]) != _key(told[k - 1]):
            return k
    return None


def chosen(told: Sequence[Moment], utc: float, second: bool, wide: float) -> Chosen:
    """The cycle that is meant by a time which stands for all from ``utc`` on for ``wide``, s, more than 0.

    Of a whole ``second`` it is that of the first change, else its first; of another time, which may be one that was
    printed and cut, the last one that had begun before it ends.
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
    """When a time ends, as exactly as cycles are told: the sum of two numbers is off by parts of a microsecond."""
    return round(utc + wide, 6)


def _before(told: Sequence[Moment], end: float) -> int:
    """Index of the last cycle that had begun before an instant."""
    return max((k for k, one in enumerate(told) if one.utc < end), default=0)


def _reach(told: Sequence[Moment], end: float) -> int:
    """Index of the last cycle that publishes what came before ``end``: that which begins next, unless it is far off."""
    last = _before(told, end + LATE_S)
    following = next((k for k, one in enumerate(told) if one.utc >= end), last)
    return max(last, following) if told[following].utc < end + SECOND_S else last


def _key(one: Moment) -> tuple[State, Reason, tuple[int, ...]]:
    return one.state, one.reason, one.faults


def faults_changed(before: Moment, one: Moment) -> list[tuple[str, int]]:
    """What has come (``+``) and gone (``-``) of the published faults between two cycles, gravest first."""
    come = [("+", fault) for fault in one.faults if fault not in before.faults]
    return come + [("-", fault) for fault in before.faults if fault not in one.faults]
