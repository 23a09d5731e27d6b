"""One drive of Fig. 6: which loops are closed, and what every judgement says of places looked at without a guess.

Three robots drive it: with lights, with the laser alone, and with lamps that are all covered. Theirs are the loops of
the daemon. Beside that, some keyframes of the first are looked for in *every* submap left 10 m of way ago, by branch
and bound over all places and headings: what comes of that is kept with every judgement, so that conditions and
thresholds can be varied afterwards.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from estimator.job_queue import SEARCH
from estimator.light_filter.light_channel import LightsSetup
from estimator.mapping.keyframe import Keyframe
from estimator.mapping.loop_verification import Candidate, Found, LoopSettings, judged, told_by_light
from estimator.measurements import LightEpoch
from estimator.numerics import se2
from estimator.pipeline import Settings, State, new_state
from estimator.result import StepResult
from tools.experiments.paper_figures.fig6_truth import Truth
from tools.experiments.support.loop_drives import half, play, room_drive, scans
from tools.experiments.support.trajectory import Errors, Track, errors, started
from tools.sim.building.world import Array
from tools.sim.light.link_drive import ROOM_WALKERS, LightRun

LIT: Final = "laser and lights"
LASER: Final = "laser alone"
COVERED: Final = "laser, lamps covered"
EVERY: Final = 80
"""Of so many keyframes one is looked for everywhere."""
ANYWHERE: Final = np.diag((3.0, 3.0, 4.0))
"""Covariance (m^2, m^2, rad^2) that makes the search take all of the room at every heading."""
FROM_S: Final = 10.0


@dataclass(slots=True)
class Detection:
    """A place where a keyframe was found, with every judgement, and whether that is so.

    Attributes:
        query, submap: the keyframe and where it was found. place: the pose found, seen from the submap.
        by_light: whether light had told where to look (else branch and bound).
        share, against, residual_m, known, shared, light: as of `Found`; light is NaN where it says nothing.
        off_m, off_rad: error of the relative pose. positive: truly the same place. reason: of an accepted loop.
    """

    query: int
    submap: int
    by_light: bool
    share: float
    against: float
    residual_m: float
    known: bool
    shared: float
    light: float
    off_m: float
    off_rad: float
    positive: bool
    place: tuple[float, float, float]
    reason: str = ""


@dataclass(slots=True)
class Way:
    """What one robot came to.

    Attributes:
        loops: accepted. asked: queries (keyframes that were looked for), and whether each has a near positive.
        errors: of its trajectory, as published (with lights in the survey's frame, else from the true start).
    """

    loops: list[Detection]
    asked: dict[int, bool]
    errors: Errors


@dataclass(slots=True)
class Drive:
    """What one drive came to: the three robots', and the places looked at without a guess."""

    seed: int
    ways: dict[str, Way]
    anywhere: list[Detection]
    queries: dict[int, bool]


class Watcher:
    """Looks on while a robot drives."""

    def __init__(self, run: LightRun, anywhere: bool) -> None:
        self.truth, self.anywhere = Truth(run), anywhere
        self.loops: list[Detection] = []
        self.places: list[Detection] = []
        self.asked: dict[int, bool] = {}
        self.queries: dict[int, bool] = {}
        self.pose: list[Array] = []
        self.t: list[float] = []
        self._frames: dict[int, Keyframe] = {}
        self._waiting: list[tuple[int, Found]] = []

    def __call__(self, state: State, result: StepResult, done: list[tuple[Any, Any]]) -> None:
        """Take down what a step has come to."""
        self.t.append(result.t_mono)
        self.pose.append(se2.compose(result.T_map_odom, result.T_odom_base))
        self._take_accepted(state)
        if result.keyframe < 0:
            return
        frame = state.map.keyframes[result.keyframe]
        self._frames[frame.key] = frame
        self.truth.laid(frame, result.t_mono)
        for job, payload in done:
            if job.priority == SEARCH and isinstance(payload, tuple):  # not where the whole map is looked through
                self.asked[frame.key] = self.truth.has_positive(frame.key)
                self._waiting += [(frame.key, found) for found in payload]
        if self.anywhere and state.jobs.keyframes % EVERY == 0:
            self._look_anywhere(state, frame)

    def _take_accepted(self, state: State) -> None:
        """Loops that have become constraints since the last scan."""
        rows = state.map.graph.constraints.T[state.map.graph.constraints.loop]
        for key, found in list(self._waiting):
            frame = self._frames[key]
            T = se2.compose(found.T_submap_keyframe, se2.between(frame.T_odom_keyframe, frame.submap.T_odom_submap))
            if len(rows) and (rows == T).all(axis=1).any():
                self._waiting.remove((key, found))
                self.loops.append(self.detection(state, key, found, False, found.reason.name))
        self._waiting = self._waiting[-40:]

    def detection(self, state: State, key: int, found: Found, by_light: bool, reason: str = "") -> Detection:
        """A place with what is true about it."""
        first = self.truth.member[found.key][0]
        off = self.truth.off(key, first, found.T_submap_keyframe)
        light = np.nan if found.light is None else found.light
        x, y, yaw = found.T_submap_keyframe.tolist()
        return Detection(
            key, found.key, by_light, found.share, found.against, found.residual_m, found.known, found.shared, light,
            *off, self.truth.positive(key, found.key), (x, y, yaw), reason,
        )  # fmt: skip

    def _look_anywhere(self, state: State, frame: Keyframe) -> None:
        """Look for a keyframe in every old submap without any guess, and where light has it."""
        told, atlas = LoopSettings(points=90), state.map.graph
        self.queries[frame.key] = self.truth.has_positive(frame.key)
        for submap in atlas.submaps.values():
            if submap.settled is None or atlas.way_m - submap.way_m < told.recent_m:
                continue
            light = told_by_light(frame, submap, told)
            middle = submap.settled.witness.T_odom_keyframe
            wide = Candidate(submap.key, submap.settled, middle, ANYWHERE, light)
            self._keep(state, frame, wide, told, False)
            if light is not None:
                near = replace(wide, T_submap_keyframe=light.T_submap_keyframe, P=light.P)
                self._keep(state, frame, near, told, True)

    def _keep(self, state: State, frame: Keyframe, asked: Candidate, told: LoopSettings, by_light: bool) -> None:
        fresh: list[Found] = []
        for found in judged(frame, asked, told):
            same = (se2.between(one.T_submap_keyframe, found.T_submap_keyframe) for one in fresh)
            if found.share > 0.3 and not any(np.hypot(d[0], d[1]) < 0.05 and abs(d[2]) < 0.02 for d in same):
                fresh.append(found)
        self.places += [self.detection(state, frame.key, found, by_light) for found in fresh]


def covered(epochs: list[LightEpoch]) -> Iterator[LightEpoch]:
    """The same epochs with every lamp covered."""
    for epoch in epochs:
        nothing = {name: getattr(epoch, name)[:0] for name in ("ids", "amplitude", "variance", "flags", "lamps")}
        yield replace(epoch, **nothing)


def trial(task: tuple[int, float]) -> Drive:
    """A drive with one seed, of some metres; every tenth one also with all lamps covered."""
    seed, length_m = task
    run = room_drive(seed, length_m)
    seen, wheels, light = list(scans(run, ROOM_WALKERS)), list(run.odometry()), half(run.light())
    ways = {}
    places, queries = [], {}
    for name in (LIT, LASER, COVERED)[: 3 if seed % 10 == 1 else 2]:
        setup = None if name == LASER else LightsSetup(run.survey, clock_ppm=0.0)
        state, watch = new_state(Settings(), setup), Watcher(run, name == LIT)
        play(state, (wheels, seen, light if name == LIT else covered(light)), watch)
        track = Track(np.array(watch.t), np.array(watch.pose), run.truth(np.array(watch.t)))
        track = track.since(FROM_S) if name == LIT else started(track)
        ways[name] = Way(watch.loops, watch.asked, errors(track))
        if name == LIT:
            places, queries = watch.places, watch.queries
    return Drive(seed, ways, places, queries)
