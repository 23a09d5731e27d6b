"""What a cycle of `step` costs without light, with light decoded already, and with a converter's samples."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from heapq import merge
from typing import Any, Final

import numpy as np

from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import UNLIMITED, Record, SampleBlock, Scan
from estimator.pipeline import State, new_state, step
from tools.experiments.support.report import Cell
from tools.sim.ceiling.links import PERIOD_S
from tools.sim.light.link_drive import ROOM_WALKERS, LightRun, room_run
from tools.sim.light.stream import LightStream
from tools.sim.scan_drive import Laser

RATE_HZ: Final = 400e3 / 18
SAMPLES: Final = 1111
BITS: Final = 12
SETTLE: Final = 0.2
"""Share of the drive that is not counted: all lamps are being found and the map is begun."""
HEAD: Final = ("", "mean", "median", "99th percentile", "iterations of the match, mean", "more than laser alone, mean")


@dataclass(slots=True, eq=False)
class Rider:
    """One estimator on the drive. ms: of each cycle; iterations: of its match."""

    name: str
    state: State
    records: Iterator[Record]
    ms: list[float] = field(default_factory=list)
    iterations: list[int] = field(default_factory=list)

    def ride(self) -> bool:
        """One cycle, up to and with the next scan; False at the end of the drive."""
        pending: list[Record] = []
        for record in self.records:
            pending.append(record)
            if isinstance(record, Scan):
                begin = time.thread_time_ns()
                result = step(self.state, pending, UNLIMITED)
                self.ms.append(1e-6 * (time.thread_time_ns() - begin))
                self.iterations.append(0 if result.match is None else result.match.iterations)
                return True
        return False


def blocks(run: LightRun, seconds: float) -> Iterator[SampleBlock]:
    """What a converter of 12 bits reads of the light, a block every 50.3 ms."""
    stream = LightStream(run.ceiling, run.truth, seed=run.seed)
    for k in range(int((seconds - 0.1) / PERIOD_S)):
        t = k * PERIOD_S + np.arange(SAMPLES) / RATE_HZ
        words = np.clip(np.rint(stream(t) * 2**BITS), 0, 2**BITS - 1)
        yield SampleBlock(float(t[0]), float(t[-1]) + 1.0 / RATE_HZ, words, RATE_HZ)


def burden(seconds: float, seed: int) -> tuple[tuple[Cell, ...], ...]:
    """Lines of the table: the first seconds of the drive in the paper's room; three estimators, cycle by cycle."""
    run = room_run(seed=seed)
    span = (0.0, min(seconds, run.seconds))
    seen, wheels = list(Laser(run, ROOM_WALKERS).scans(span)), [r for r in run.odometry() if r.t_end <= span[1]]
    epochs, samples = [r for r in run.light() if r.t_end <= span[1]], list(blocks(run, span[1]))
    riders = []
    for name, light in (
        ("laser alone", None),
        ("with light, decoded", epochs),
        ("with light, decoding included", samples),
    ):
        state = new_state(lights=None if light is None else LightsSetup(run.survey, clock_ppm=0.0))
        streams: list[Any] = [wheels, seen] if light is None else [wheels, seen, light]
        riders.append(Rider(name, state, merge(*streams, key=lambda record: record.t_end)))
    while all([rider.ride() for rider in riders]):  # noqa: C419  # all of them ride, also after one is done
        pass
    first = int(SETTLE * len(riders[0].ms))
    base = float(np.mean(riders[0].ms[first:]))
    return tuple(line_of(rider, first, base) for rider in riders)


def line_of(rider: Rider, first: int, base: float) -> tuple[Cell, ...]:
    """A line of the table."""
    ms = np.array(rider.ms[first:])
    mean = float(ms.mean())
    return (
        rider.name,
        mean,
        float(np.median(ms)),
        float(np.percentile(ms, 99)),
        float(np.mean(rider.iterations[first:])),
        mean - base,
    )
