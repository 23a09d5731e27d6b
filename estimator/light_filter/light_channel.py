"""The light half of a step: the decoder and the `lights` filter of one photodiode, loaded only where there is one."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimator.cdma import decoder
from estimator.cdma.air_interface import PROFILE_A, Profile
from estimator.cdma.epoch import UNUSABLE, LightEpoch, SampleBlock
from estimator.light_filter import light_filter
from estimator.light_filter.filter_state import SILENT_S
from estimator.light_filter.initialisation import Place
from estimator.light_filter.link_association import strong_at
from estimator.light_filter.residual_lookup import ResidualCorrections
from estimator.light_filter.residual_map import ResidualMap
from estimator.light_filter.survey import Survey
from estimator.measurements import Imu, Odometry, Record
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.result import LightsResult


@dataclass(frozen=True, slots=True)
class LightsSetup:
    """A photodiode and what it looks at.

    Attributes:
        survey: the lamps and the receiver; without lamps in it, they have to describe themselves.
        profile: air interface and front end.
        clock_ppm: stored error of the sample clock, good to 200 ppm; None: not known yet.
        residuals: what the survey does not explain, place by place, learned with this survey; None: no such map.
    """

    survey: Survey = field(default_factory=Survey)
    profile: Profile = PROFILE_A
    clock_ppm: float | None = None
    residuals: ResidualMap | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """What an epoch has said of a pose, and whether that was with the pose compared with the `lights` filter's."""

    epoch: LightEpoch
    T_map_base: Array
    compared: bool
    misplaced: bool


class LightChannel:
    """What is known from light, without a place by the laser.

    Attributes:
        setup: as given. decoder: of the photodiode's blocks. filter: see estimator/light_filter/light_filter.py.
        result: after the latest
            epoch. epoch: that epoch, None before the first. glimpse: places at which an epoch fits by itself. guided:
            instant and pose (odom frame) of the latest scan, if its match may tell how the robot moves; see `guide`.
        asked: what `light_evidence.misplaced` was asked last.
    """

    def __init__(self, setup: LightsSetup) -> None:
        """Nothing seen yet; raises ValueError for a stored clock out of range or an impossible survey."""
        self.setup = setup
        hung = {lamp.code for lamp in setup.survey.lamps}
        self.decoder = decoder.new_decoder(setup.profile, setup.clock_ppm, hung)
        learned = None if setup.residuals is None else ResidualCorrections(setup.residuals, setup.survey.receiver)
        self.filter = light_filter.new_lights(setup.survey, corrections=learned)
        self.result = light_filter.result(self.filter)
        self.epoch: LightEpoch | None = None
        self.glimpse: tuple[LightEpoch, tuple[Place, ...]] | None = None
        self.guided: tuple[float, Array] | None = None
        self.asked: Asked | None = None
        self._decoded = self._decoded_before = False
        self._spared = 0

    def predict(self, record: Record) -> None:
        """Move the `lights` filter with the robot, by what wheels and gyro say."""
        if isinstance(record, Odometry | Imu):
            light_filter.predict(self.filter, record)

    @property
    def has_motion(self) -> bool:
        """Whether wheels or matches give the motion to the light filter."""
        return self.filter.course.wheels

    @property
    def on_wheels(self) -> bool:
        """Whether it is wheels that give it."""
        return self.filter.course.wheels and not self.filter.course.matched

    def move(self, record: Odometry, velocity: Array) -> None:
        """Where no wheels tell how the robot moves: move the `lights` filter by what matches say of it."""
        light_filter.move(self.filter, record, velocity)

    def left_alone(self) -> None:
        """Matches do not tell that any more."""
        light_filter.left_alone(self.filter)

    def take(self, record: SampleBlock | LightEpoch) -> LightsResult:
        """Decode a block, if it is one, and take the epoch into the filter."""
        self._decoded = isinstance(record, SampleBlock)
        self.epoch = decoder.decode(self.decoder, record) if isinstance(record, SampleBlock) else record
        self.result = light_filter.update(self.filter, self.epoch)
        return self.result

    def look_on(self, codes: int) -> None:
        """Go on looking for lamps that are not followed yet, as far as this cycle can afford.

        Where only every other cycle brings a block, the one that has decoded it leaves the search, and the effort that
        it was allowed, to the next: a lamp is found before the next block all the same, and no cycle does both.
        """
        busy = self._decoded and not self._decoded_before and len(self.decoder.tracks.slots) > 0
        self._decoded_before, self._decoded = self._decoded, False
        if busy:
            self._spared = codes
            return
        spared, self._spared = self._spared, 0
        decoder.search(self.decoder, codes + spared)

    def place(self, T_map_base: Array, covariance: Array) -> None:
        """Somebody says where the robot is."""
        light_filter.place(self.filter, T_map_base, covariance)

    def reset(self) -> None:
        """Forget the place and what was learned of the lamps."""
        light_filter.reset(self.filter)


def silent(light: LightChannel) -> bool:
    """Whether there is no usable epoch of now."""
    epoch = light.epoch
    return epoch is None or light.filter.course.t_mono - epoch.t_end > SILENT_S or bool(epoch.block & UNUSABLE)


def too_strong_at(light: LightChannel | None, T_map_base: Array) -> list[bool]:
    """Of each lamp that is received now, whether it is stronger than it can be near a pose (x, y, yaw; map frame).

    Reads the latest epoch alone, neither the filter, which wheels can lead astray, nor the heading, of which strengths
    know nothing. Of lamps of one code the nearest counts. Empty without a usable epoch.
    """
    if light is None or silent(light):
        return []
    lights, epoch = light.filter, light.epoch
    assert epoch is not None
    rx = lights.survey.receiver
    (x, y) = se2.apply(T_map_base, np.array(((rx.x, rx.y),)))[0].tolist()
    return strong_at(lights, epoch, x, y)
