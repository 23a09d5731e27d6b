"""A small lit room for tests of the `lights` filter: strengths by the filter's own model, with chosen departures."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from estimator.cdma.data_frame import LampFrame
from estimator.cdma.epoch import BlockFlag, LightEpoch, LinkFlag
from estimator.light_filter.lambertian import expected
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.measurements import Array, Odometry
from estimator.numerics import se2

RECEIVER = Receiver(x=-0.1, y=0.03, z=0.3)
LAMPS = tuple(Lamp(k + 1, k, 1.25 + 2.5 * (k % 4), 1.25 + 2.5 * (k // 4), 2.9, sigma_ln=0.05) for k in range(16))
SURVEY = Survey(LAMPS, RECEIVER)


@dataclass
class Room:
    """What is true, and what happens to it.

    Attributes:
        lamps: as they truly hang and shine. survey: for receiver and depth. noise: relative, of each strength.
        cover: (lamp_id, t) -> share of the light that passes. frames: lamps say what they are.
    """

    lamps: Sequence[Lamp] = LAMPS
    survey: Survey = SURVEY
    noise: float = 0.002
    seed: int = 0
    cover: Callable[[int, float], float] = field(default=lambda _lamp, _t: 1.0)
    frames: dict[int, LampFrame] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._rng = np.random.default_rng(self.seed)

    def epoch(self, t: float, pose: Array, least: float = 2e-9) -> LightEpoch:
        """What the decoder says of the 50 ms around ``t``."""
        strength = expected(self.lamps, self.survey, pose).amplitude
        strength = strength * [self.cover(lamp.lamp_id, t) for lamp in self.lamps]
        strength = strength * (1.0 + self.noise * self._rng.standard_normal(len(self.lamps)))
        heard = np.flatnonzero(strength > least)
        codes = np.array([self.lamps[k].code for k in heard], dtype=np.int64)
        again = np.array([int(LinkFlag.TWIN) if np.sum(codes == code) > 1 else 0 for code in codes], dtype=np.int64)
        lamps = tuple(self.frames.get(self.lamps[k].lamp_id) for k in heard)
        variance = np.full(len(heard), 1e-9**2 / 4)
        return LightEpoch(
            t - 0.025, t + 0.025, codes, strength[heard], variance, again, lamps, BlockFlag.NONE, 1e-9, 0.0
        )


def circle(t: float, speed: float = 0.4, radius: float = 2.5) -> Array:
    """A round drive in the middle of the room, counter-clockwise."""
    a = speed * t / radius
    return np.array((5.0 + radius * math.cos(a), 5.0 + radius * math.sin(a), se2.wrap(a + 0.5 * math.pi)))


def wheels(poses: Callable[[float], Array], t: float, dt: float, scale: float = 1.0) -> Odometry:
    """What wheels say of the interval that ends at ``t``."""
    return Odometry(t - dt, t, se2.between(poses(t - dt), poses(t)) * np.array((scale, scale, 1.0)))


def drive(
    room: Room, poses: Callable[[float], Array], seconds: float, start: float = 0.0
) -> Iterator[tuple[float, Odometry, LightEpoch]]:
    """Ten epochs a second with the odometry that leads to each."""
    for k in range(1, round(seconds * 10) + 1):
        t = start + 0.1 * k
        yield t, wheels(poses, t, 0.1, 1.01), room.epoch(t, poses(t))
