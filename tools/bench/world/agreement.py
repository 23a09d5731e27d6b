"""Whether two runs of one scenario said the same: as the robot got along, where was it put?

The same drive twice on a robot's computer, or there and in virtual time: the truth is the same, so what differs is
what was published. Scans do not fall on the same instants, so the errors are compared,
which change slowly, at equal ways driven. When the first loop is closed the whole map moves by what that loop is good
for, which is centimetres, and with which keyframe it is closed depends on the scans: until then two runs say the same.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.bench.report.plots import Plot, Series
from tools.bench.report.result import Figure
from tools.bench.world.judge import Errors, Played, errors_of
from tools.bench.world.scenario import Scenario
from tools.sim.harness import run

Array = npt.NDArray[np.float64]
STEP_M: Final = 0.05
FINE_S: Final = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Trace:
    """Errors along a drive: (n,) metres driven, (n, 2) error of the place in the frame in which it began, m."""

    driven: Array
    off: Array


def trace(played: Played) -> Trace:
    """Of a run, until it closed a loop."""
    loops = played.reads[0].loops if played.reads else 0
    closed_s = next((one.t for one in played.reads if one.answered and one.loops != loops), math.inf)
    seconds = np.arange(0.0, min(alike_s(played.scenario), closed_s), FINE_S)
    return _trace(errors_of(played), seconds, played.truth(seconds))


def _trace(found: Errors, seconds: Array, truth: Array) -> Trace:
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    inside = (found.t >= seconds[0]) & (found.t <= seconds[-1])
    return Trace(np.interp(found.t[inside], seconds, driven), found.off[inside, :2])


def alike_s(scenario: Scenario) -> float:
    """Seconds until the first fault: what it does depends on the scan that it strikes, so two runs may differ then."""
    return min([scenario.drive.seconds, *(float(fault.get("when", 0.0)) for fault in scenario.faults)])


def reference(scenario: Scenario) -> Trace:
    """The same scenario with the daemon in this process and in virtual time, until its first fault or loop."""
    scene, seconds = scenario.scene(held=False), alike_s(scenario)
    made = run(seconds, scene=scene, odometry=scenario.world.odometry)
    t0 = float(scene.t_go or 0.0)
    kept = np.isfinite(made.pose[:, 0])
    off = made.pose[kept] - made.truth[kept]
    errors = Errors(made.t_mono[kept] - t0, off, made.pose[kept], made.sigma[kept, 0])
    closed_s = next((one.t_mono - t0 for one in made.snapshots if one.loop_counter), math.inf)
    fine = np.arange(0.0, min(seconds, closed_s), FINE_S)
    return _trace(errors, fine, scene.truth(t0 + fine))


def differences(one: Trace, other: Trace) -> tuple[Array, Array]:
    """(n,) metres driven and (n,) distance between what the two say, every 5 cm of the way that both have."""
    first, last = max(one.driven.min(), other.driven.min()), min(one.driven.max(), other.driven.max())
    at = np.arange(first, last, STEP_M)
    gap = [_at(one, at, k) - _at(other, at, k) for k in range(2)]
    return at, np.asarray(np.hypot(*gap))


def _at(one: Trace, driven: Array, axis: int) -> Array:
    order = np.argsort(one.driven, kind="stable")
    return np.asarray(np.interp(driven, one.driven[order], one.off[order, axis]))


def figures(one: Trace, other: Trace, names: str) -> tuple[tuple[Figure, ...], tuple[Plot, ...]]:
    """For a report; the largest is the last figure. Where no way is in both, there is none to be compared."""
    at, gap = differences(one, other)
    way, middle, largest = (np.ptp(at), np.median(gap), gap.max()) if len(at) else (0.0, math.nan, math.nan)
    told = (
        Figure(f"{names}: way compared", float(way), "m", "less", 0.25),
        Figure(f"{names}: apart, median", 1e3 * float(middle), "mm", "more", 0.5, 2.0),
        Figure(f"{names}: apart, largest", 1e3 * float(largest), "mm", "more", 0.5, 5.0),
    )
    return told, (Plot(f"{names}: apart", "m driven", "mm", (Series("", at.tolist(), (1e3 * gap).tolist()),)),)
