"""A day in the office: does memory, or the time of a cycle, grow with the hours, or only with the area?

A robot drives lap after lap through the office floor (60 rooms, people walking) with 90 beams and lamps at link level;
what grows after the first lap would never stop growing. ``make bench ARGS=day`` drives an hour; the long forms::

    python -m tools.bench.system.day --hours 24                # one scan a second
    python -m tools.bench.system.day --hours 2 --scans 40      # forty
    python -m tools.bench.system.day --hours 24 --dark         # laser and wheels alone

Every scan, epoch of light and odometry increment has noise of its own; what the lamps send is computed once per second
of the lap. Times are processor time of `step`; background jobs run between two steps and are not counted.
"""

from __future__ import annotations

import argparse
import gc
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from daemon.runtime.worker import CycleWorker
from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import UNLIMITED, Beam, LightEpoch, Odometry, Scan
from estimator.numerics import se2
from estimator.pipeline import State, new_state, step
from tools.bench.cycle import resident_mb
from tools.ci.figures import Figure, bounded, save, table
from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.buildings import building
from tools.sim.building.people import Crowd
from tools.sim.ceiling.ceiling import Array, Effects, ceiling_of
from tools.sim.ceiling.links import EPOCH_S, Links
from tools.sim.ceiling.movers import lean_of, walkers_of
from tools.sim.ceiling.records import frames, light_epoch, survey
from tools.sim.robot.drive import Body, Drive, compose
from tools.sim.robot.odometry import Odometer, Wheels

COMMAND: Final = "python -m tools.bench.system.day"
BEAMS: Final = 90
SWEEP_S: Final = 0.0125
SIGMA_M: Final = 0.01
BLOCKS: Final = 4
ROWS: Final = ("hours", "resident", "median", "p99", "worst", "keyframes", "submaps", "constraints", "hung", "error")


@dataclass(slots=True)
class Course:
    """What is driven: hours, scans a second, with or without lamps, odometry readings a second."""

    hours: float = 1.0
    scans: float = 1.0
    lit: bool = True
    seed: int = 0
    wheels_hz: float = 10.0


class Robot:
    """What the devices deliver, second after second."""

    def __init__(self, course: Course) -> None:
        place = building("office_floor")
        self.course, self._crowd = course, Crowd(place.people)
        drive = Drive(place.route, Body())
        self.lap_s = int(np.ceil(drive.lap_s))
        self.drive = Drive(place.route, Body(), drive.dwell_s + self.lap_s - drive.lap_s)
        sweep = Sweep(np.linspace(-0.75 * np.pi, 0.75 * np.pi, BEAMS), 0.0, SWEEP_S)
        self._scanner = Scanner(place.world, sweep, UTM_30LX, course.seed)
        self._odometer = Odometer(self.drive, place.world, Wheels(rate_hz=course.wheels_hz), course.seed)
        self._ceiling = ceiling_of(place, Effects(gain_spread=0.05), course.seed)
        self._ceiling.lean, self._ceiling.movers = lean_of(self.drive), walkers_of(place.people)
        self._links, self._told = Links(self._ceiling, None, course.seed), frames(self._ceiling)
        self._lamps: dict[int, Array] = {}
        self.survey = survey(self._ceiling)
        self._read, self._count, self._seq = self._odometer.reading(0), 0, 0

    def second(self, number: int) -> Iterator[tuple[Scan | LightEpoch | Odometry, ...]]:
        """Records of each scan's cycle in that second; light comes with the first."""
        for k in range(max(round(self.course.scans), 1)):
            begin = number + k / self.course.scans
            scan = self._scan(begin)
            light = (self._light(number),) if self.course.lit and k == 0 else ()
            yield (*light, *self._wheels(scan.t_end), scan)

    def truth(self, t: float) -> Array:
        """T_building_base."""
        return np.asarray(self.drive.pose(np.array([t]))[0])

    def _scan(self, begin: float) -> Scan:
        legs = self._crowd.legs(begin, self.truth(begin))
        posture = Posture(self.drive.body.height, *self.drive.tilt(begin))
        mount = self.drive.body.lidar
        seen = self._scanner.measure(begin, lambda at: compose(self.drive.pose(at), mount), legs, posture)
        reach = 1e-3 * np.rint(1e3 * seen.range_m[:, 0])
        beam = np.where(reach > 0.0, np.uint8(Beam.HIT), np.uint8(Beam.NONE))
        bearing, self._seq = self._scanner.sweep.bearing_rad, self._seq + 1
        return Scan(begin, begin + SWEEP_S, self._seq, np.array(mount), bearing, reach, beam, SIGMA_M)

    def _light(self, number: int) -> LightEpoch:
        t = number - EPOCH_S
        if (into := number % self.lap_s) not in self._lamps:
            at = np.array([t + 0.5 * EPOCH_S])
            self._lamps[into] = self._ceiling.amplitudes(self.drive.pose(at), at)[0]
        for _ in range(BLOCKS):  # the decoder follows its lamps all the time; the filter gets one block in so many
            report = self._links.report(t, t + EPOCH_S, self._lamps[into])
        return light_epoch(self._ceiling, report, self._told)

    def _wheels(self, until: float) -> Iterator[Odometry]:
        rate = self.course.wheels_hz
        while (self._count + 1) / rate <= until:
            before, self._count = self._read, self._count + 1
            self._read = self._odometer.reading(self._count)
            yield Odometry((self._count - 1) / rate, self._count / rate, se2.between(before, self._read))


@dataclass(slots=True)
class Log:
    """One row per window, in the order of :data:`ROWS`; of the window under way: seconds per step, errors in m."""

    window_s: int
    lap_s: int
    rows: list[tuple[float, ...]] = field(default_factory=list)
    took: list[float] = field(default_factory=list)
    errors: list[float] = field(default_factory=list)

    def close(self, hours: float, state: State) -> None:
        """End a window."""
        gc.collect()
        ms, atlas = 1e3 * np.array(self.took), state.map.graph
        hung = sum(len(submap.hung) for submap in atlas.submaps.values())
        counts = len(state.map.keyframes), len(atlas.submaps), len(atlas.constraints.loop), hung
        times = float(np.median(ms)), float(np.percentile(ms, 99)), float(ms.max())
        self.rows.append((hours, resident_mb(), *times, *map(float, counts), float(np.median(self.errors))))
        self.took.clear()
        self.errors.clear()

    def column(self, name: str) -> Array:
        """One of :data:`ROWS`."""
        return np.array([row[ROWS.index(name)] for row in self.rows])


def drive(course: Course, windows: int = 96, say: bool = False) -> Log:
    """Drive it. The first laps count as laps: the log begins with the start."""
    robot, worker = Robot(course), CycleWorker()
    state = new_state(lights=LightsSetup(robot.survey, clock_ppm=0.0) if course.lit else None)
    seconds = round(3600.0 * course.hours)
    log = Log(max(seconds // windows, 1), robot.lap_s)
    origin = robot.truth(0.0)
    for number in range(seconds):
        for records in robot.second(number + 1):
            answers = worker.collect(records[-1].t_end)
            begin = time.thread_time()
            result = step(state, (*answers, *records), UNLIMITED)
            log.took.append(time.thread_time() - begin)
            worker.submit(result.jobs)
        x, y, _ = se2.between(
            robot.truth(result.t_mono) if course.lit else se2.between(origin, robot.truth(result.t_mono)),
            se2.compose(result.T_map_odom, result.T_odom_base),
        ).tolist()
        log.errors.append(float(np.hypot(x, y)))
        if (number + 1) % log.window_s == 0:
            log.close((number + 1) / 3600.0, state)
            if say:
                print(
                    "  ".join(f"{name} {value:.3g}" for name, value in zip(ROWS, log.rows[-1], strict=True)), flush=True
                )
    return log


def figures(log: Log, command: str) -> list[Figure]:
    """Slopes after the first lap, by least squares over the windows."""
    hours = log.column("hours")
    after = hours * 3600.0 >= max(log.lap_s, 0.15 * hours[-1] * 3600.0)
    slope = {name: float(np.polyfit(hours[after], log.column(name)[after], 1)[0]) for name in ROWS[1:]}
    median = log.column("median")[after]
    quarter = max(len(median) // 4, 1)
    growth = float(np.median(median[-quarter:]) / np.median(median[:quarter]))
    rows = [Figure("simulated hours", float(hours[-1]), "h", command=command)]
    rows.append(Figure("laps", float(hours[-1] * 3600.0 / log.lap_s), "", command=command))
    rows.append(bounded("memory, slope", slope["resident"], "MB/h", "<= 0.5", command))
    rows.append(Figure("memory at the end", float(log.column("resident")[-1]), "MB", command=command))
    rows.append(bounded("median of a step, last over first quarter", growth, "ratio", "<= 1.1", command))
    rows += [
        Figure(f"step, {name} of the last window", float(log.column(name)[-1]), "ms", command=command)
        for name in ("median", "p99", "worst")
    ]
    for name in ("keyframes", "submaps", "constraints", "hung"):
        rows.append(Figure(f"{name} at the end", float(log.column(name)[-1]), "", command=command))
        rows.append(Figure(f"{name}, slope", slope[name], "1/h", command=command))
    rows.append(Figure("position error, median of all windows", float(np.median(log.column("error"))), "m"))
    return rows


def draw(log: Log, path: Path) -> None:
    """Memory, counts and time of a step over the hours."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    hours = log.column("hours")
    figure, (top, middle, bottom) = plt.subplots(3, 1, figsize=(7.0, 6.0), sharex=True, layout="constrained")
    top.plot(hours, log.column("resident"))
    top.set_ylabel("resident memory, MB")
    for name in ("keyframes", "submaps", "constraints"):
        middle.plot(hours, log.column(name), label=name)
    middle.set_ylabel("count")
    middle.legend()
    for name in ("median", "p99"):
        bottom.plot(hours, log.column(name), label=name)
    bottom.set_ylabel("step, processor time, ms")
    bottom.set_xlabel("simulated hours")
    for axes in (top, middle, bottom):
        axes.set_ylim(bottom=0.0)
        axes.grid(visible=True, alpha=0.3)
    bottom.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def run() -> list[Figure]:
    """An hour."""
    return figures(drive(Course(), 24), f"{COMMAND} --hours 1")


def main() -> None:
    """The long forms."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated (default %(default)s)")
    parser.add_argument("--scans", type=float, default=1.0, help="a second (default %(default)s)")
    parser.add_argument("--dark", action="store_true", help="without lamps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    command = f"{COMMAND} --hours {options.hours:g} --scans {options.scans:g}{' --dark' * options.dark}"
    wheels = 50.0 if options.scans > 10.0 else 10.0
    course = Course(options.hours, options.scans, not options.dark, options.seed, wheels)
    least = 2.0 * Robot(course).lap_s / 3600.0
    if options.hours < least:
        parser.error(
            f"--hours {options.hours:g} is less than two laps: what grows after the first shows from {least:.2g} on"
        )
    log = drive(course, say=True)
    rows = figures(log, command)
    print(table(rows))
    draw(log, options.out / "day.png")
    print(f"written: {save('day', rows, options.out)}, {options.out / 'day.png'}")


if __name__ == "__main__":
    main()
