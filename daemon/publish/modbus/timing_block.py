"""Modbus block for cycle timing: degradation level, stage times, stalls.

    Modbus    magic u16, version u16 | seq u32, POINTS, big-endian, high word first | seq_end u32     at 354

The contract is that of the other tables: under the same version a point never moves and never changes its meaning.
Quantiles are those of the last half minute to minute, and so is the maximum.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import attrgetter
from typing import Final

from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import U16, U32, Point, Rule, Value
from daemon.snapshot import CycleTiming, Snapshot, Stage

RUNGS: Final = (
    "all work is done",
    "fewer iterations and points",
    "also no map work",
    "also no lidar: the pose uses light and odometry",
)
"""Meaning of the degradation levels, by number. Part of the contract: never renumber."""

STAGES: Final = {
    Stage.BRIDGE: "results of background jobs, and conversion of device readings",
    Stage.LIGHTS: "decoding of a block of samples, and the light filter",
    Stage.SEARCH: "acquisition of lamps that are not tracked yet",
    Stage.MATCH: "scan match and pose update",
    Stage.MAP: "keyframes and loop closures",
    Stage.STEP: "the rest of the estimator step",
    Stage.JUDGE: "state, protection level and snapshot",
    Stage.PUBLISH: "registers, datagrams, stream and recording",
    Stage.OUTSIDE: "time between cycles",
}
"""Meaning of the stages of a cycle, by number."""

Getter = Callable[[Snapshot], Value]
_STAGES: Final = tuple(Stage)[:-1]
"""In the order of the block; the last one of :class:`Stage` is no stage."""
_ROWS: Final[tuple[tuple[str, str, str], ...]] = (
    ("cycle", "whole cycle", "Computing time of a cycle."),
    (
        "late",
        "start delay of a cycle",
        "From its due time (a complete scan, or the end of the idle period) to its start.",
    ),
    *((stage.name.lower(), f"stage {stage.name}", "") for stage in _STAGES),
)


def _pulse(name: str) -> Getter:
    value = attrgetter(name)
    return lambda snapshot: None if snapshot.pulse is None else value(snapshot.pulse)


def _count(name: str) -> Getter:
    value = attrgetter(name)
    return lambda snapshot: 0 if snapshot.pulse is None else value(snapshot.pulse)


def _spread(row: int, place: int) -> Getter:
    """Getter of quantile ``place`` (0 median, 1 p99, 2 maximum) of a row, s."""

    def get(snapshot: Snapshot) -> Value:
        pulse = snapshot.pulse
        spread = None if pulse is None else _row_of(pulse, row)
        return None if spread is None else spread[place] * 1e-6

    return get


def _row_of(pulse: CycleTiming, row: int) -> tuple[int, int, int] | None:
    if row < 2:
        return pulse.late if row else pulse.cycle
    return pulse.stages[row - 2] if row - 2 < len(pulse.stages) else None


def _quantiles(row: int) -> tuple[Point, ...]:
    name, label, text = _ROWS[row]
    return tuple(
        Point(f"{name}_{quantile}", f"{label}, {said}", U16, _spread(row, place), text, 100_000, "s")
        for place, (quantile, said) in enumerate((("p50", "median"), ("p99", "99 of 100"), ("max", "largest")))
    )


_NAMES: Final = ", ".join(f"{stage.value} {stage.name}" for stage in Stage)
_RUNGS: Final = ", ".join(f"{number} {text}" for number, text in enumerate(RUNGS))

POINTS: Final = (
    Point("rung", "degradation level", U16, _count("rung"), f"{_RUNGS}.", can_be_unknown=False),
    Point("thinned", "cycles on degradation level 1", U32, _count("thinned"), "Since the start.", rule=Rule.WRAP,
          can_be_unknown=False),
    Point("without_map", "cycles on degradation level 2", U32, _count("without_map"), "Since the start.",
          rule=Rule.WRAP,
          can_be_unknown=False),
    Point("carried", "cycles on degradation level 3", U32, _count("carried"),
          "Since the start, including those during a pause.",
          rule=Rule.WRAP, can_be_unknown=False),
    Point("stalls", "stalls", U16, _count("stalls"), "Cycles that began more than two periods late, since the start.",
          rule=Rule.WRAP, can_be_unknown=False),
    Point("stall", "latest stall", U16, _pulse("stall_s"), "Duration of the latest one. Not known before the first.",
          1_000, "s"),
    Point("stall_in", "latest stall, where", U16, _pulse("stall_in"),
          f"Work at that time: {_NAMES}. Not known before the first."),
    *(point for row in range(len(_ROWS)) for point in _quantiles(row)),
)  # fmt: skip

BLOCK: Final = Block("the cycle", 354, "LC", 1, POINTS)
