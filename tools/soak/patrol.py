"""A robot on its rounds for weeks: 90 beams a second, lamps at link level, wheels; cheap enough for two million scans.

What the building looks like from each second of a lap, and what the lamps send there, is computed once; noise of range,
light and wheels is new every time.
"""

from dataclasses import replace
from typing import Final

import numpy as np

from estimator.cdma.epoch import LightEpoch
from estimator.light_filter.survey import Survey
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry
from tools.sim.building.beams import UTM_30LX, Posture, Scanner, Sweep
from tools.sim.building.buildings import building
from tools.sim.building.people import Crowd
from tools.sim.ceiling.ceiling import Array, Effects, ceiling_of
from tools.sim.ceiling.links import EPOCH_S, Links
from tools.sim.ceiling.movers import lean_of, walkers_of
from tools.sim.ceiling.records import frames, light_epoch, survey
from tools.sim.robot.drive import Body, Drive, compose
from tools.sim.robot.odometry import Odometer, Wheels

BEAMS: Final = 90
STEP_RAD: Final = np.radians(3.0)
SWEEP_S: Final = 0.0125
SIGMA_M: Final = 0.01
LIGHT_S: Final = 2
"""A block of light every so many seconds of the lap; a lap is a whole number of them."""
BLOCKS: Final = 4
"""Blocks that the decoder has followed its lamps by then, of which the last one counts."""
WHEELS_HZ: Final = 10.0
"""The filter bridges half a second without wheels."""
REST_S: Final = 600.0
"""On its charger after each lap of some five minutes: half of what may grow grows only where it stands."""


class Patrol:
    """What the devices deliver.

    Attributes:
        lap_s: of the tour. survey: what the daemon is told of the lamps. geometry: of the lidar. mount: T_base_lidar.
    """

    def __init__(self, name: str, seed: int = 0) -> None:
        place = building(name)
        body, rng = Body(), np.random.default_rng((seed, 5))
        drive = Drive(place.route, body)
        self.lap_s = LIGHT_S * int(np.ceil((drive.lap_s + REST_S) / LIGHT_S))
        self._drive = Drive(place.route, body, drive.dwell_s + self.lap_s - drive.lap_s)
        self.mount = body.lidar
        self.geometry = LidarGeometry(
            "UTM-30LX", "SIM00000", "soak", 120, 45, 0, BEAMS - 1, 23, 60_000, 1e-3, 1.0, SWEEP_S / BEAMS
        )
        self._rng, self._seq, self._count = rng, 0, 0
        self._scanner = Scanner(place.world, Sweep(STEP_RAD * (np.arange(BEAMS) - 45), 0.0, SWEEP_S), UTM_30LX, seed)
        self._odometer = Odometer(self._drive, place.world, Wheels(rate_hz=WHEELS_HZ), seed)
        self._crowd, self._height = Crowd(place.people), body.height
        self._ceiling = ceiling_of(place, Effects(gain_spread=0.05), seed)
        self._ceiling.lean, self._ceiling.movers = lean_of(self._drive), walkers_of(place.people)
        self._links, self._told = Links(self._ceiling, None, seed), frames(self._ceiling)
        self._seen: dict[int, Array] = {}
        self._lit: dict[int, Array] = {}
        self.survey: Survey = survey(self._ceiling)

    def truth(self, t: float) -> Array:
        """T_building_base."""
        return np.asarray(self._drive.pose(np.array([t]))[0])

    def scan(self, number: int) -> RawScan:
        """The scan that begins with that second."""
        into = number % self.lap_s
        if into not in self._seen:
            self._seen[into] = self._look(float(into))
        seen = self._seen[into]
        words = np.rint(1e3 * (seen + SIGMA_M * self._rng.standard_normal(BEAMS))).astype(np.int32)
        valid = (seen > 0.0) & (words >= self.geometry.dmin)
        self._seq += 1
        return RawScan(
            geometry=self.geometry,
            seq=self._seq,
            t_rx=number + SWEEP_S,
            t_mono=float(number),
            t_sigma=1e-4,
            t_tick=-1,
            first_step=0,
            stride=1,
            ranges=np.where(valid, words, 0).astype(np.int32),
            code=np.where(valid, VALID, 1).astype(np.int32),
        )

    def light(self, number: int) -> LightEpoch | None:
        """The block that ends with that second, if one does."""
        if number % LIGHT_S:
            return None
        t, into = number - EPOCH_S, number % self.lap_s
        if into not in self._lit:
            at = np.array([into + self.lap_s - 0.5 * EPOCH_S])
            self._lit[into] = self._ceiling.amplitudes(self._drive.pose(at), at)[0]
        for _ in range(BLOCKS):
            report = self._links.report(t, t + EPOCH_S, self._lit[into])
        return replace(light_epoch(self._ceiling, report, self._told), t_end=float(number))

    def wheels(self, until: float) -> list[RawOdometry]:
        """Readings up to an instant."""
        due = []
        while (self._count + 1) / WHEELS_HZ <= until:
            self._count += 1
            t, (x, y, yaw) = self._count / WHEELS_HZ, self._odometer.reading(self._count).tolist()
            due.append(RawOdometry(t, t, x, y, yaw))
        return due

    def _look(self, t: float) -> Array:
        """Ranges without noise; where nothing is met, nothing."""
        legs = self._crowd.legs(t, self.truth(t))
        posture = Posture(self._height, *self._drive.tilt(t))
        seen = self._scanner.measure(t, lambda at: compose(self._drive.pose(at), self.mount), legs, posture)
        return np.asarray(seen.range_m[:, 0])
