"""A lit drive for the tests of the whole step: odometry and light of a link-level run, scans of the simulated lidar."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from heapq import merge

import numpy as np

from estimator.light_filter.light_channel import LightsSetup
from estimator.measurements import UNLIMITED, Array, Beam, LightEpoch, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, State, new_state, step
from estimator.result import Fix, LightsResult, StepResult
from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.light.link_drive import LightRun

Truth = Callable[[Array], Array]
"""(n, 3) poses at (n,) times."""
MOUNT = (0.15, 0.0, 0.0)
BEARING = np.radians(np.linspace(-90.0, 90.0, 361))


def scans(run: LightRun, truth: Truth | None = None, rate_hz: float = 10.0) -> Iterator[Scan]:
    """What a 180 deg lidar measures on the drive; nobody walks about for it."""
    sweep, where = Sweep(BEARING, 0.0, 0.5 / rate_hz), truth or run.truth
    scanner = Scanner(run.world, sweep, UTM_30LX, run.seed)
    for k in range(int(run.seconds * rate_hz)):
        t = k / rate_hz
        seen = scanner.measure(t, lambda at: _mounted(where(at)), np.zeros((0, 7)), Posture()).range_m[:, 0].copy()
        beam = np.where(seen > 0.0, Beam.HIT, Beam.NONE).astype(np.uint8)
        yield Scan(t, t + sweep.sweep_s, k, np.array(MOUNT), BEARING, seen, beam, 0.01)


def _mounted(poses: Array) -> Array:
    return np.array([se2.compose(T, np.array(MOUNT)) for T in poses])


@dataclass
class Log:
    """What a run has come to, one row per step that ended with a light epoch or a scan."""

    t: list[float] = field(default_factory=list)
    error: list[Array] = field(default_factory=list)
    P: list[Array] = field(default_factory=list)
    results: list[StepResult] = field(default_factory=list)

    def after(self, t: float, before: float = np.inf) -> slice:
        """Rows of a span of time."""
        return slice(int(np.searchsorted(self.t, t)), int(np.searchsorted(self.t, before)))

    def rmse(self, t: float, before: float = np.inf) -> tuple[float, float]:
        """Of position (m) and of heading (rad)."""
        e = np.array(self.error[self.after(t, before)])
        return float(np.sqrt(np.mean(e[:, 0] ** 2 + e[:, 1] ** 2))), float(np.sqrt(np.mean(e[:, 2] ** 2)))

    def nees(self, t: float, before: float = np.inf) -> float:
        """Mean squared Mahalanobis distance of position and heading; 3 where the covariance is honest."""
        rows = self.after(t, before)
        return float(np.mean([e @ np.linalg.solve(P, e) for e, P in zip(self.error[rows], self.P[rows], strict=True)]))

    def fixes(self, t: float, before: float = np.inf) -> set[Fix]:
        """Of light."""
        return {r.lights.fix for r in self.results[self.after(t, before)] if r.lights is not None}


def lit_state(run: LightRun) -> State:
    """A robot that has just been switched on and knows the survey."""
    return new_state(Settings(), LightsSetup(run.survey, clock_ppm=0.0))


def play(state: State, records: Iterable[Record], truth: Truth) -> Log:
    """All records through `step`, one step for each scan or epoch."""
    log, pending = Log(), list[Record]()
    for record in records:
        pending.append(record)
        if isinstance(record, Scan | LightEpoch):
            result = step(state, pending, UNLIMITED)
            pending = []
            error = se2.compose(result.T_map_odom, result.T_odom_base) - truth(np.array([result.t_mono]))[0]
            error[2] = se2.wrap(error[2])
            log.t.append(result.t_mono)
            log.error.append(error)
            log.P.append(result.covariance)
            log.results.append(result)
    return log


def together(*streams: Iterable[Record]) -> Iterator[Record]:
    """In order of the ends of their intervals."""
    return merge(*streams, key=lambda record: record.t_end)  # type: ignore[union-attr]  # orders are not among them


def lights_at(T: Array, accepted: frozenset[int], state: State) -> LightsResult:
    """Sure of a place, by these lamps."""
    P = np.diag((0.05**2, 0.05**2, 0.02**2))
    now = state.motion.t_mono
    nothing = np.zeros((3, 3))
    return LightsResult(now, Fix.GOOD, T, P, (), accepted, nothing, np.zeros(3), t_pose=now)
