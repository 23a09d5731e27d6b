"""From a found loop to the corrected pose, in a map of 1000 submaps, and what that work costs the cycles meanwhile.

Two of the daemon's cycles take the same scans (1081 beams, wheels) in turn, five seconds each, at 40 Hz of real time:
one with the daemon's threads for jobs and a map of 1000 submaps whose graph is solved after every second, the
other with its own small map and no jobs at all. The first gets a loop into the old map as an answer of the search,
which moves the pose by 8 cm; the clock runs from the cycle that takes this answer to the end of the one whose
``T_map_odom`` has changed. How long cycles take is compared between the two.
"""

import argparse
import gc
import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np

from daemon.config.schema import LidarConfig, Mount
from daemon.devices.conversion import ScanBridge
from daemon.runtime.budget import MeasuredBudget
from daemon.runtime.cycle import Cycle
from daemon.runtime.cycle_parts import Parts
from daemon.runtime.stage_times import StageTimer
from daemon.runtime.warmup import load
from daemon.runtime.worker import ThreadWorker, Worker
from daemon.system.realtime import line_up
from estimator.job_queue import SEARCH
from estimator.mapping.keyframe import Settled
from estimator.mapping.loop_closure import found_again
from estimator.mapping.loop_verification import Found, LoopSettings
from estimator.measurements import Array, Job
from estimator.numerics import se2
from estimator.pipeline import State, new_state, step
from hal.adc import RawSamples
from hal.lidar import LidarStatus, Link
from tools.bench.support.drive import Delivery, EndlessDrive
from tools.bench.support.first import before_others
from tools.bench.support.manual_clock import ManualClock
from tools.bench.support.old_map import SUBMAPS, old_map
from tools.bench.support.stages import WALL, Stages, quantiles
from tools.ci.figures import Figure, bounded, save, table

COMMAND: Final = "python -m tools.bench.system.liveloop"
BLOCK: Final = 200
"""Scans that one cycle takes before the other has its turn."""
EVERY: Final = 40
"""Scans from one loop to the next."""
MOVED: Final = np.array((0.08, 0.0, 0.0))


class Drive(EndlessDrive):
    """Without light."""

    def _samples(self, until: float) -> tuple[RawSamples, ...]:
        return ()


class Idle:
    """A worker that drops its jobs."""

    failed = 0

    def submit(self, jobs: Iterable[Job]) -> None:
        """See :class:`daemon.runtime.worker.Worker`."""

    def collect(self, t_mono: float) -> tuple[()]:
        """See :class:`daemon.runtime.worker.Worker`."""
        return ()

    def close(self) -> None:
        """See :class:`daemon.runtime.worker.Worker`."""


@dataclass(slots=True)
class Side:
    """One of the two: its estimator, its cycle, its times, and its latencies in ms."""

    state: State
    cycle: Cycle
    stages: Stages
    waited: list[float] = field(default_factory=list)
    begun: float = 0.0
    changed: Array | None = None
    taken: int = 0


def side(drive: EndlessDrive, count: int, clock: ManualClock, worker: Worker) -> Side:
    """A cycle around an estimator of its own."""
    x, y, yaw = drive.scene.mount
    state = new_state()
    parts = Parts(
        clock=clock,
        step=partial(step, state),
        scans=ScanBridge(LidarConfig(device="/dev/bench", mount=Mount(x, y, float(np.degrees(yaw))))),
        budget=MeasuredBudget(),
        worker=worker,
        status=LidarStatus(link=Link.STREAMING),
        odometry=True,
        timer=StageTimer(time.perf_counter),
    )
    return Side(state, Cycle(parts), Stages((), count))


def offer_loop(one: Side, rng: np.random.Generator) -> None:
    """Let the search have found the newest keyframe in an old submap, a little off from where it was expected."""
    atlas, told = one.state.map.graph, LoopSettings()
    frame = one.state.map.keyframes[one.state.pose.anchor]
    old = int(rng.choice([key for key, submap in atlas.submaps.items() if submap.way_m < -100.0]))
    T = se2.compose(se2.between(atlas.submaps[old].T_map_submap, frame.T_map_keyframe), MOVED * rng.choice((-1.0, 1.0)))
    found = Found(old, T, np.diag((0.01, 0.01, 0.003)) ** 2, 0.95, 0.0, 0.02, MOVED)

    def then(payload: object) -> None:
        found_again(atlas, told, frame, found)
        one.begun, one.changed = time.perf_counter(), one.state.pose.T_map_odom

    atlas.jobs.ask(SEARCH, lambda: found, then)


def pass_by(one: Side, due: Delivery, number: int) -> None:
    """One cycle of one side."""
    for reading in due.odometry:
        one.cycle.inbox.put_odometry(reading)
    one.cycle.inbox.put_scan(due.scan)
    if number >= 0:
        one.stages.run(one.cycle.run)
    else:
        one.cycle.run()
    if one.changed is not None and one.state.pose.T_map_odom is not one.changed:
        one.waited.append(1e3 * (time.perf_counter() - one.begun))
        one.changed = None


def measure(seconds: float, submaps: int = SUBMAPS, settle_s: float = 10.0, pace_s: float = 0.025) -> tuple[Side, Side]:
    """Both sides after so many seconds each: the one with the large map, and the one without."""
    load()
    drive, clock = Drive(), ManualClock()
    warm, count = round(settle_s / 0.025), BLOCK * max(round(seconds / 0.025 / BLOCK), 1)
    worker = ThreadWorker()
    line_up()
    busy, quiet = side(drive, count, clock, worker), side(drive, count, clock, Idle())
    deliveries = [next(drive) for _ in range(warm + count)]
    for number in range(warm):
        clock.t = deliveries[number].t_mono
        pass_by(quiet, deliveries[number], -1)
    settled = settled_of(quiet)
    old_map(busy.state, submaps, settled)
    for number in range(warm):
        clock.t = deliveries[number].t_mono
        pass_by(busy, deliveries[number], -1)
        time.sleep(0.002)
    gc.collect()
    gc.freeze()
    rng = np.random.default_rng(1)
    for block in range(warm, warm + count, BLOCK):
        for one in (quiet, busy):
            begin = time.perf_counter()
            for k in range(BLOCK):
                if one is busy and k % EVERY == 0 and one.changed is None:
                    offer_loop(one, rng)
                clock.t = deliveries[block + k].t_mono
                pass_by(one, deliveries[block + k], k)
                time.sleep(max(0.0, begin + (k + 1) * pace_s - time.perf_counter()))
    worker.close()
    return busy, quiet


def settled_of(one: Side) -> Settled:
    """Some submap of the drive so far, settled here and now."""
    from estimator.mapping.keyframe import settle

    frames = list(one.state.map.keyframes.values())[:12]
    return settle(frames, frames[0].T_odom_keyframe, 0.01)


def figures(busy: Side, quiet: Side) -> list[Figure]:
    """All rows."""
    waited = np.array(busy.waited or [np.inf])
    rows = [
        Figure("submaps", float(len(busy.state.map.graph.submaps)), "", command=COMMAND),
        Figure("loops timed", float(len(busy.waited)), "", command=COMMAND),
        Figure("loop to corrected pose, median", float(np.median(waited)), "ms", command=COMMAND),
        bounded("loop to corrected pose, longest", float(waited.max()), "ms", "<= 100", COMMAND),
    ]
    times = {name: one.stages.of("cycle", WALL) for name, one in (("with jobs", busy), ("without", quiet))}
    for name, us in times.items():
        rows += [
            Figure(f"cycle {name}, {q}", 1e-3 * value, "ms", command=COMMAND) for q, value in quantiles(us).items()
        ]
    growth = quantiles(times["with jobs"])["p99.9"] - quantiles(times["without"])["p99.9"]
    return [*rows, bounded("growth of the cycle's p99.9", 1e-3 * growth, "ms", "<= 1", COMMAND)]


def run(seconds: float = 20.0) -> list[Figure]:
    """Twenty seconds each, with the daemon's real-time rights where they may be had."""
    with before_others(os.geteuid() == 0):
        return figures(*measure(seconds))


def main() -> None:
    """The long form."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--seconds", type=float, default=100.0, help="of each side (default %(default)s)")
    parser.add_argument("--submaps", type=int, default=SUBMAPS)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    with before_others(os.geteuid() == 0):
        rows = figures(*measure(options.seconds, options.submaps))
    print(table(rows))
    print(f"written: {save('liveloop', rows, options.out)}")


if __name__ == "__main__":
    main()
