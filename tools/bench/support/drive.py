"""What a robot's devices deliver on an endless drive under 16 coded lamps, for benchmarks of whole cycles.

1081 beams at 40 Hz, wheel odometry at 50 Hz, and blocks of converter words, of which the light has to be decoded. Laps
through the paper's room repeat the scans of the first one; light and odometry go on, crystals, frames and noise
included, so that neither decoder nor odometry ever meets a seam.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from estimator.light_filter.survey import Survey
from hal.adc import Blemish, RawSamples
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry
from tools.sim.building.buildings import building
from tools.sim.light.link_drive import ROOM_BODY, ROOM_ROUTE, ROOM_WALKERS
from tools.sim.light.scene import Lights, SceneLight
from tools.sim.scene import Scenario, SimulatedScene

MODEL: Final = "UTM-30LX"
PERIOD_S: Final = 0.025
SAMPLES: Final = 1111
SAMPLE_RATE: Final = 400e3 / 18
BLOCK_PERIOD_S: Final = 0.0503
"""50 ms of samples and the bus's overhead."""
LATE_S: Final = 60e-6
"""Largest ordinary delay of a time stamp of the bus."""
BITS: Final = 12


@dataclass(frozen=True, slots=True)
class Delivery:
    """What has arrived since the last scan; ``t_mono`` is when the scan was complete."""

    t_mono: float
    scan: RawScan
    odometry: tuple[RawOdometry, ...]
    samples: tuple[RawSamples, ...]


class EndlessDrive:
    """Deliveries, one per scan, for as long as they are asked for.

    Attributes:
        survey: what the daemon is told of the lamps. geometry: of the lidar. scene: the truth.
    """

    def __init__(self, t_begin: float = 100.0, seed: int = 0) -> None:
        place = replace(building("paper_room"), route=ROOM_ROUTE, people=ROOM_WALKERS)
        self.scene = SimulatedScene(Scenario(lidar=MODEL, body=ROOM_BODY, seed=seed, lights=Lights()), place)
        assert self.scene.light is not None
        self._light: SceneLight = self.scene.light
        self._light.prepare()
        self.survey: Survey = self._light.survey
        model = self.scene.model
        self.geometry = LidarGeometry(
            MODEL, "SIM00000", "bench", model.ares, model.afrt, model.amin, model.amax, model.dmin, model.dmax,
            1e-3, PERIOD_S, model.true_period_s / model.ares,
        )  # fmt: skip
        self._lap = round(self.scene.drive.lap_s / PERIOD_S)
        self._period = self.scene.drive.lap_s / self._lap  # a lap is a whole number of scans
        self._ranges = np.full((self._lap, model.amax - model.amin + 1), -1, dtype=np.int32)
        self._t_begin, self._count, self._blocks = t_begin, 0, 0
        self._t_block = self._t_odometry = self.scene.begin(t_begin)
        self._rng = np.random.default_rng((seed, 17))

    def __next__(self) -> Delivery:
        """The next scan and what came before it."""
        number, self._count = self._count, self._count + 1
        scan = self._scan(number)
        return Delivery(scan.t_rx, scan, self._odometry(scan.t_rx), self._samples(scan.t_rx))

    def _scan(self, number: int) -> RawScan:
        g, place = self.geometry, number % self._lap
        t = self._t_begin + number * self._period
        words = self._ranges[place]
        if number < self._lap:
            words[:] = self.scene.scan(t).ranges_mm[g.amin : g.amax + 1]
        valid = (words >= g.dmin) & (words <= g.dmax)
        return RawScan(
            geometry=g,
            seq=number,
            t_rx=t + g.beam_dt_s * g.amax + 2e-3,
            t_mono=t + g.beam_dt_s * g.amin,
            t_sigma=1e-4,
            t_tick=-1,
            first_step=g.amin,
            stride=1,
            ranges=np.where(valid, words, 0).astype(np.int32),
            code=np.where(valid, VALID, words).astype(np.int32),
        )

    def _odometry(self, until: float) -> tuple[RawOdometry, ...]:
        readings: list[RawOdometry] = []
        while True:
            t, pose = self.scene.odometry_after(self._t_odometry)
            if t > until:
                return tuple(readings)
            self._t_odometry = t
            readings.append(RawOdometry(t, t, float(pose[0]), float(pose[1]), float(pose[2])))

    def _samples(self, until: float) -> tuple[RawSamples, ...]:
        blocks: list[RawSamples] = []
        while self._t_block + SAMPLES / SAMPLE_RATE + LATE_S < until:
            blocks.append(self._block(self._t_block))
            self._t_block += BLOCK_PERIOD_S
        return tuple(blocks)

    def _block(self, t_begin: float) -> RawSamples:
        t = t_begin + np.arange(SAMPLES) / SAMPLE_RATE
        words = np.clip(np.round(self._light.sample(t) * 2**BITS), 0, 2**BITS - 1).astype(np.uint16)
        early, late = self._rng.uniform(0.1, 1.0, 2) * LATE_S
        seq, self._blocks = self._blocks, self._blocks + 1
        t0, t1 = t_begin - float(early), float(t[-1]) + 1.0 / SAMPLE_RATE + float(late)
        return RawSamples(seq, t0, t1, t0, SAMPLE_RATE, words, BITS, Blemish.NONE, float(early + late))
