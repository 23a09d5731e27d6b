"""A drive round and round in the paper's room with odometry that drifts, straight into keyframes and loops."""

import itertools
from dataclasses import replace

import numpy as np

from estimator.mapping.keyframe import keep
from estimator.mapping.loop_closure import add_keyframe, take_answer
from estimator.mapping.loop_verification import LoopSettings
from estimator.measurements import Answer, Array, Job
from estimator.numerics import se2
from estimator.result import Loop
from estimator.state import State, new_state
from tests.estimator.world import scan_in
from tools.bench.support.scenes import bearings, paper_room

HALF = bearings(181, 180.0)
SMALL = np.diag((0.004**2, 0.004**2, 0.002**2))
TOLD = LoopSettings()
BARE = scan_in(paper_room(), se2.identity(), HALF, np.random.default_rng(0))


def circuit(step: float = 0.25, laps: float = 1.3) -> Array:
    """Poses along a rounded square of 6 m in the paper's room, through its middle lane: (n, 3)."""
    angle = np.linspace(0.0, laps * 2.0 * np.pi, int(laps * 2.0 * np.pi * 3.4 / step))
    return np.column_stack((3.6 * np.cos(angle), 3.6 * np.sin(angle), angle + 0.5 * np.pi))


def drifted(truth: Array, scale: float, turn: float) -> Array:
    """What odometry makes of a path: every step ``scale`` too long and turned by ``turn`` rad too much."""
    poses = [truth[0]]
    for a, b in itertools.pairwise(truth):
        poses.append(se2.compose(poses[-1], se2.between(a, b) * (scale, scale, 1.0) + (0.0, 0.0, turn)))
    return np.array(poses)


def run_jobs(state: State) -> list[Job]:
    """Every job at once, and what its answer asks for; returns them."""
    done = []
    while jobs := state.jobs.take():
        for job in jobs:
            take_answer(state.map, state.pose, state.motion, Answer(0.0, job.job_id, job.run()))
            done.append(job)
    return done


def lay(state: State, T_odom: Array, T_true: Array, rng: np.random.Generator, key: int, anew: bool = False) -> None:
    scan = scan_in(paper_room(), T_true, HALF, rng)
    state.motion.T_odom_base = state.pose.T_odom_anchor = T_odom
    frame = keep(key, se2.compose(state.pose.T_map_odom, T_odom), T_odom, scan, 0.0)
    add_keyframe(state.map, state.pose, frame, (SMALL, 0.01, anew))
    state.map.keyframes[key] = frame


def driven(
    laps: float = 1.3,
    settings: LoopSettings | None = TOLD,
    turn: float = 0.0008,
    news: list[Loop | None] | None = None,
) -> tuple[State, Array]:
    """A state after the circuit with drift, all jobs done as they came; and the true poses. Loops go to ``news``."""
    state, truth = new_state(), circuit(laps=laps)
    state.use(replace(state.settings, loops=settings))
    rng = np.random.default_rng(2)
    state.motion.T_odom_base = state.map.T_map_start = truth[0]
    for key, (T_odom, T_true) in enumerate(zip(drifted(truth, 1.004, turn), truth, strict=True), 1):
        lay(state, T_odom, T_true, rng, key)
        run_jobs(state)
        if news is not None:
            news.append(state.map.graph.take_news())
    return state, truth
