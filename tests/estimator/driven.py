"""Drives of the simulated robot through the simulated buildings, for the estimator alone: no bytes, no daemon."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from estimator.measurements import UNLIMITED, Array, Beam, Odometry, Record, Scan
from estimator.numerics import se2
from estimator.pipeline import Settings, State, new_state, step
from estimator.result import StepResult
from tools.sim.building.building import Building
from tools.sim.scene import Scenario, SimulatedScene, sweep_of

START_S = 10.0


@dataclass(frozen=True, eq=False)
class Driven:
    """What came out, a row a scan: instants (n,), true poses (n, 3) as seen from the first one, results, the state."""

    t: Array
    truth: Array
    results: list[StepResult]
    state: State

    @property
    def error_m(self) -> Array:
        """Distance of T_odom_base from the truth, (n,)."""
        poses = np.array([r.T_odom_base for r in self.results])
        return np.asarray(np.hypot(*(poses - self.truth)[:, :2].T))

    @property
    def step_error_m(self) -> Array:
        """Error of each scan's motion since the scan before, (n,)."""
        made = [se2.between(a.T_odom_base, b.T_odom_base) for a, b in zip(self.results, self.results[1:], strict=False)]
        true = [se2.between(a, b) for a, b in zip(self.truth, self.truth[1:], strict=False)]
        return np.append(0.0, np.hypot(*(np.array(made) - np.array(true))[:, :2].T))


def records(scene: SimulatedScene, seconds: float, hz: float, odometry: bool) -> Iterator[tuple[float, list[Record]]]:
    """Instant of each scan's end, and what has come since the last: wheel increments, and the scan."""
    sweep, model = sweep_of(scene.model), scene.model
    kept = slice(model.amin, model.amax + 1)
    wheels: tuple[float, Array] | None = None
    for seq in range(int(seconds * hz)):
        t = START_S + seq / hz
        seen = scene.scan(t).ranges_mm[kept]
        begin = t + sweep.first_s
        end = begin + sweep.sweep_s
        kind = np.where((seen >= model.dmin) & (seen <= model.dmax), np.uint8(Beam.HIT), np.uint8(Beam.NONE))
        found: list[Record] = []
        while odometry:
            after = scene.odometry_after(START_S if wheels is None else wheels[0])
            if after is None or after[0] > end:
                break
            if wheels is not None:
                found.append(Odometry(wheels[0], after[0], se2.between(wheels[1], after[1])))
            wheels = after
        mount = np.array(scene.mount)
        found.append(Scan(begin, end, seq, mount, sweep.bearing_rad, 1e-3 * seen, kind, 0.01))
        yield end, found


def drive(
    scenario: Scenario, seconds: float, hz: float, odometry: bool = True, place: Building | None = None
) -> Driven:
    """Run the estimator over a drive."""
    scene = SimulatedScene(scenario, place)
    state = new_state(Settings())
    t, results = [], []
    for end, found in records(scene, seconds, hz, odometry):
        results.append(step(state, found, UNLIMITED))
        t.append(end)
    site = scene.truth(np.array(t))
    truth = np.array([se2.compose(results[0].T_odom_base, se2.between(site[0], pose)) for pose in site])
    return Driven(np.array(t), truth, results, state)
