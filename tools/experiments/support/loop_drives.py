"""Drives that leave a place and come back to it, with loops closed: cheap enough for fifty of them.

Everything is at the level of `step`: decoded light epochs, a lidar of 180 deg with 181 beams ten times a second, wheels
that slip. Jobs of the background worker are done between two steps; their answers come with the next one.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from heapq import merge
from typing import Any, Final

import numpy as np

from estimator.measurements import UNLIMITED, Answer, Beam, LightEpoch, Record, Scan
from estimator.pipeline import State, step
from estimator.result import StepResult
from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.people import Crowd, Walker
from tools.sim.ceiling.movers import lean_of
from tools.sim.light.link_drive import LightRun, room_run
from tools.sim.robot.drive import Body, Drive, Route, compose

BEARING: Final = np.radians(np.linspace(-90.0, 90.0, 181))
RATE_HZ: Final = 10.0
SIGMA_M: Final = 0.01
BODY: Final = Body(speed=0.9)
LANES: Final = (-3.7, -1.1, 1.1, 3.7)
"""Where a robot may drive in the paper's room, along either axis, without touching a column."""
HOME: Final = (-3.7, -3.7)


def room_route(seed: int, length_m: float = 160.0) -> Route:
    """A random way along the lanes of the paper's room, of about that length, which returns to its start."""
    rng = np.random.default_rng((seed, 77))
    at, corners, way, along = list(HOME), [HOME], 0.0, 0
    while len(corners) < 4 or way < length_m - 12.0:
        there = float(rng.choice([lane for lane in LANES if lane != at[along]]))
        way += abs(there - at[along])
        at[along], along = there, 1 - along
        corners.append((at[0], at[1]))
    for along in (0, 1):  # home along the lanes, and back to where the first corner looks
        if at[along] != HOME[along]:
            at[along] = HOME[along]
            corners.append((at[0], at[1]))
    return Route(tuple(corners[:-1] if corners[-1] == HOME else corners), 1.2)


def room_drive(seed: int, length_m: float = 160.0, body: Body = BODY) -> LightRun:
    """A random drive in the paper's room under its 16 lamps; wheels as those whose dead reckoning ends 1.5 m off."""
    run = room_run(seed=seed)
    drive = Drive(room_route(seed, length_m), body, 2.0, 1)
    run.ceiling.lean = lean_of(drive)
    return replace(run, drive=drive, seconds=drive.lap_s)


def scans(run: LightRun, walkers: tuple[Walker, ...] = ()) -> Iterator[Scan]:
    """What the lidar measures on a drive."""
    sweep, crowd = Sweep(BEARING, 0.0, 0.5 / RATE_HZ), Crowd(walkers)
    scanner, body = Scanner(run.world, sweep, UTM_30LX, run.seed), run.drive.body
    for k in range(int(run.seconds * RATE_HZ)):
        t = k / RATE_HZ
        legs = crowd.legs(t, run.truth(np.array([t]))[0])
        posture = Posture(body.height, *run.drive.tilt(t))
        seen = scanner.measure(t, lambda at: compose(run.truth(at), body.lidar), legs, posture).range_m[:, 0].copy()
        beam = np.where(seen > 0.0, Beam.HIT, Beam.NONE).astype(np.uint8)
        yield Scan(t, t + sweep.sweep_s, k, np.array(body.lidar), BEARING, seen, beam, SIGMA_M)


def half(epochs: Iterable[LightEpoch]) -> list[LightEpoch]:
    """Every other epoch of light: ten a second."""
    return list(epochs)[::2]


Watch = Callable[[State, StepResult, list[tuple[Any, Any]]], None]
"""Is told of a state after each scan, with the jobs done since the last one and their answers' payloads."""


def play(state: State, streams: Iterable[Iterable[Record]], watch: Watch) -> None:
    """All records through `step`, one step a scan; what a step asks for is done before the next one."""
    pending: list[Record] = []
    ordered: Iterable[Any] = merge(*streams, key=lambda record: record.t_end)  # type: ignore[union-attr]  # no orders
    for record in ordered:
        pending.append(record)
        if isinstance(record, Scan):
            result = step(state, pending, UNLIMITED)
            done = [(job, job.run()) for job in result.jobs]
            pending = [Answer(record.t_end, job.job_id, payload) for job, payload in done]
            watch(state, result, done)
