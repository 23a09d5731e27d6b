"""What a time-of-flight lidar makes of the light: detection limit, noise, bias, dropouts, mixed pixels, speckle.

Not modelled: interference by another lidar, sunlight, rain and dust, temperature drift, a beam's height over the floor
other than through pitch and roll, retroreflectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.sim.building.raycast import cast_scan
from tools.sim.building.world import Array, SimWorld, material_table

KNOTS: Final = 17  # poses per scan between which the motion is taken as linear
ECHOES: Final = 3

Poses = Callable[[Array], Array]
"""Poses (n, 3) in the building's frame at (n,) instants, yaw unwrapped."""


@dataclass(frozen=True, slots=True)
class Optics:
    """How a kind of lidar measures; figures follow the makers' accuracy and repeatability statements.

    Attributes:
        half_divergence_rad: half the angle a beam covers. white_range_m: where a white wall met squarely is just seen.
        sigma_m: range noise of a strong echo. sigma_weak_m: additional noise of an echo at the detection limit.
        pulse_m: echoes closer together than this melt into one.
        leading_edge: share of the spread within an echo by which the range comes out short.
        dark_bias_m: by how much a weak echo comes out long. dropout: chance that a beam returns nothing at all.
        speckle: chance of an arbitrary range. limit_m: beyond this nothing is reported.
        intensity_gain: device units for energy 1, under a square-root law.
    """

    half_divergence_rad: float = 0.0015
    white_range_m: float = 56.0
    sigma_m: float = 0.007
    sigma_weak_m: float = 0.045
    pulse_m: float = 0.4
    leading_edge: float = 0.4
    dark_bias_m: float = 0.02
    dropout: float = 1e-3
    speckle: float = 2e-5
    limit_m: float = 60.0
    intensity_gain: float = 9000.0

    @property
    def threshold(self) -> float:
        """Energy of the weakest echo that is seen (see the unit in :mod:`tools.sim.building.raycast`)."""
        return 0.9 / self.white_range_m**2


UTM_30LX: Final = Optics()
UST_20LX: Final = Optics(white_range_m=34.0, sigma_m=0.008, limit_m=60.0)
URG_04LX: Final = Optics(
    half_divergence_rad=0.004, white_range_m=6.5, sigma_m=0.008, sigma_weak_m=0.03, pulse_m=1.0, limit_m=5.6
)
IDEAL: Final = Optics(
    half_divergence_rad=0.0, white_range_m=1e4, sigma_m=0.0, sigma_weak_m=0.0, leading_edge=0.0, dark_bias_m=0.0,
    dropout=0.0, speckle=0.0,
)  # fmt: skip
"""No error of its own: for tests of the geometry."""


@dataclass(frozen=True, slots=True, eq=False)
class Sweep:
    """Bearings (n,) in the lidar frame and when they are measured: ``first_s`` after step 0, lasting ``sweep_s``."""

    bearing_rad: Array
    first_s: float
    sweep_s: float


@dataclass(frozen=True, slots=True)
class Posture:
    """How the scan plane lies: height over the floor, pitch and roll in rad (positive: ahead, left points down)."""

    height_m: float = 0.3
    pitch: float = 0.0
    roll: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Returns:
    """Measured echoes: (n, 3) ranges in m, first to last, 0 where there is none, and (n, 3) device intensities."""

    range_m: Array
    intensity: npt.NDArray[np.int32]


class Scanner:
    """A lidar in a world. What it returns is a function of time, poses and seed: the same call gives the same scan."""

    def __init__(self, world: SimWorld, sweep: Sweep, optics: Optics, seed: int = 0) -> None:
        self.sweep = sweep
        self.optics = optics
        self._seed = seed
        self._bounds = world.bounds
        cell_shapes = np.ascontiguousarray(world.shapes[world.cell_items])
        self._world = cell_shapes, world.cell_start, world.frame, material_table(), world.polished
        count = len(sweep.bearing_rad)
        self._beams = np.zeros((count, 3))
        self._beams[:, 0] = sweep.bearing_rad
        self._beams[:, 1] = np.linspace(0.0, 1.0, count)

    def measure(self, t: float, poses: Poses, movers: Array, posture: Posture) -> Returns:
        """One scan whose step 0 is passed at ``t``.

        Args:
            t: seconds on the scene's clock.
            poses: of the lidar.
            posture: of the scan plane.
            movers: (m, 7) moving circles true at ``t + first_s``, see :mod:`tools.sim.building.people`.

        Raises:
            ValueError: the lidar is outside the building.
        """
        optics, sweep = self.optics, self.sweep
        rng = np.random.default_rng((self._seed, round(t * 1e6) & 0xFFFFFFFFFFFF))
        count = len(self._beams)
        noise = rng.standard_normal((2, count))
        self._beams[:, 2] = optics.threshold * np.exp(0.15 * noise[0])
        knots = np.ascontiguousarray(poses(t + sweep.first_s + np.linspace(0.0, sweep.sweep_s, KNOTS)))
        self._require_inside(knots)
        physics = np.array(
            [
                optics.half_divergence_rad, optics.limit_m, optics.pulse_m,
                posture.height_m, posture.pitch, posture.roll, sweep.sweep_s,
            ]
        )  # fmt: skip
        seen = np.empty((count, ECHOES, 3))
        cast_scan(knots, self._beams, self._world, movers, physics, seen)
        return self._received(seen, noise[1], rng)

    def _require_inside(self, knots: Array) -> None:
        x_min, y_min, x_max, y_max = self._bounds
        low, high = knots[:, :2].min(axis=0), knots[:, :2].max(axis=0)
        if low[0] < x_min or low[1] < y_min or high[0] > x_max or high[1] > y_max:
            raise ValueError(f"lidar at ({knots[0, 0]:.1f}, {knots[0, 1]:.1f}) is outside the building {self._bounds}")

    def _received(self, seen: Array, noise: Array, rng: np.random.Generator) -> Returns:
        optics = self.optics
        energy = seen[:, :, 1]
        hit = energy > 0.0
        weakness = optics.threshold / np.where(hit, energy, 1.0)
        sigma = np.sqrt(optics.sigma_m**2 + optics.sigma_weak_m**2 * weakness + (0.3 * seen[:, :, 2]) ** 2)
        if optics.sigma_m == 0.0:
            sigma[:] = 0.0
        bias = optics.dark_bias_m * np.sqrt(weakness) - optics.leading_edge * seen[:, :, 2]
        reach = seen[:, :, 0] + bias + sigma * noise[:, None]
        hit &= (reach > 0.0) & (reach < optics.limit_m)
        luck = rng.random(len(noise))
        hit[luck < optics.dropout] = False
        strange = luck > 1.0 - optics.speckle
        reach[strange] = rng.uniform(0.1, min(optics.limit_m, 30.0), (int(strange.sum()), ECHOES))
        hit[strange] = (True, False, False)
        intensity = np.where(hit, optics.intensity_gain * np.sqrt(energy) + 1.0, 0.0)
        return Returns(np.where(hit, reach, 0.0), np.minimum(intensity, 262143).astype(np.int32))
