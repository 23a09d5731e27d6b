"""Scans of a drive as the records `step` takes: a simulated lidar on the way of a `link_drive.LightRun`.

Ranges are rounded to the millimetres that the sensor sends; everything else between sensor and estimator (wire, driver,
clock) is left out. Used where a whole daemon would only cost time.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

import numpy as np

from estimator.measurements import Beam, Scan
from hal.fake.lidar.models import LidarModel
from tools.sim.building.beams import UTM_30LX, Posture, Scanner
from tools.sim.building.people import Crowd, Walker
from tools.sim.building.world import Array
from tools.sim.light.link_drive import LightRun
from tools.sim.robot.drive import compose
from tools.sim.scene import OPTICS, lidar_model, sweep_of

SIGMA_M: Final = 0.01
"""Range noise that the data sheet of this kind of lidar promises."""


class Laser:
    """The lidar on a drive. What it sees is a function of the drive, the model and the number of the revolution.

    Args:
        run: the drive. walkers: people, who began to walk at 0. lidar: name of the model.
    """

    def __init__(self, run: LightRun, walkers: tuple[Walker, ...] = (), lidar: str = "paper") -> None:
        self.model, self._drive, self._crowd = lidar_model(lidar), run.drive, Crowd(walkers)
        self._sweep, self._mount = sweep_of(self.model), np.array(run.drive.body.lidar)
        self._scanner = Scanner(run.world, self._sweep, OPTICS.get(lidar, UTM_30LX), run.seed)

    def scan(self, k: int) -> Scan:
        """Revolution ``k``, which begins ``k`` periods after the drive did."""
        sweep, body, start = self._sweep, self._drive.body, k * self.model.true_period_s
        begin = start + sweep.first_s
        legs = self._crowd.legs(begin, self._drive.pose(np.array([begin]))[0])
        posture = Posture(body.height, *self._drive.tilt(begin))
        seen = self._scanner.measure(start, lambda at: compose(self._drive.pose(at), body.lidar), legs, posture)
        reach = reported(self.model, seen.range_m[:, 0])
        beam = np.where(reach > 0.0, np.uint8(Beam.HIT), np.uint8(Beam.NONE))
        return Scan(begin, begin + sweep.sweep_s, k, self._mount, sweep.bearing_rad, reach, beam, SIGMA_M)

    def scans(self, span: tuple[float, float]) -> Iterator[Scan]:
        """All revolutions that begin, and end, between two instants, s."""
        period = self.model.true_period_s
        for k in range(int(np.ceil(span[0] / period)), int(span[1] / period)):
            yield self.scan(k)


def reported(model: LidarModel, range_m: Array) -> Array:
    """Ranges as the model sends them: millimetres, 0 where it sends none."""
    out = 1e-3 * np.rint(1e3 * range_m)
    return np.where((out >= 1e-3 * model.dmin) & (out <= 1e-3 * model.dmax), out, 0.0)
