"""Light channel of one photodiode: decoder and light filter, loaded only where there is a photodiode."""

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
    """Configuration of a photodiode and its lamps.

    Attributes:
        survey: the lamps and the receiver; without lamps in it, they have to describe themselves.
        profile: air interface and front end.
        clock_ppm: stored error of the sample clock, good to 200 ppm; None: not known yet.
        residuals: residual map, learned with this survey; None: no such map.
    """

    survey: Survey = field(default_factory=Survey)
    profile: Profile = PROFILE_A
    clock_ppm: float | None = None
    residuals: ResidualMap | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """Consistency of an epoch with a pose.

    Attributes:
        epoch, T_map_base: the epoch and the pose.
        compared: whether the pose was compared with that of the light filter.
        misplaced: whether the epoch is inconsistent with the pose.
    """

    epoch: LightEpoch
    T_map_base: Array
    compared: bool
    misplaced: bool


class LightChannel:
    """Decoder, light filter and latest results of one photodiode; independent of the lidar's position.

    Attributes:
        setup: as given. decoder: of the photodiode's blocks. filter: see estimator/light_filter/light_filter.py.
        result: after the latest epoch. epoch: that epoch, None before the first.
        glimpse: single-epoch fix: an epoch and the positions at which it fits by itself.
        guided: instant and pose (odom frame) of the latest scan, if its match can serve as odometry; see `guide`.
        asked: last result of `light_evidence.misplaced`.
    """

    def __init__(self, setup: LightsSetup) -> None:
        """Channel without any light yet.

        Raises:
            ValueError: a stored clock out of range or an impossible survey.
        """
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
        """Predict the light filter with odometry or gyro; other records are ignored."""
        if isinstance(record, Odometry | Imu):
            light_filter.predict(self.filter, record)

    @property
    def has_motion(self) -> bool:
        """Whether wheels or scan matches give odometry to the light filter."""
        return self.filter.course.wheels

    @property
    def on_wheels(self) -> bool:
        """Whether that odometry comes from wheels."""
        return self.filter.course.wheels and not self.filter.course.matched

    def move(self, record: Odometry, velocity: Array) -> None:
        """Predict the light filter with lidar odometry, where there are no wheels."""
        light_filter.move(self.filter, record, velocity)

    def left_alone(self) -> None:
        """End the lidar odometry."""
        light_filter.left_alone(self.filter)

    def take(self, record: SampleBlock | LightEpoch) -> LightsResult:
        """Decode a block, or accept a decoded epoch, and update the filter."""
        self._decoded = isinstance(record, SampleBlock)
        self.epoch = decoder.decode(self.decoder, record) if isinstance(record, SampleBlock) else record
        self.result = light_filter.update(self.filter, self.epoch)
        return self.result

    def look_on(self, codes: int) -> None:
        """Search for further lamps with the effort of ``codes`` codes.

        If only every other cycle brings a block, the cycle that decoded it postpones search and effort to the next. A
        lamp is still found before the next block, and no cycle does both.
        """
        busy = self._decoded and not self._decoded_before and len(self.decoder.tracks.slots) > 0
        self._decoded_before, self._decoded = self._decoded, False
        if busy:
            self._spared = codes
            return
        spared, self._spared = self._spared, 0
        decoder.search(self.decoder, codes + spared)

    def place(self, T_map_base: Array, covariance: Array) -> None:
        """Set the pose of the robot (operator pose), with its covariance."""
        light_filter.place(self.filter, T_map_base, covariance)

    def reset(self) -> None:
        """Clear the pose and everything learned about the lamps."""
        light_filter.reset(self.filter)


def silent(light: LightChannel) -> bool:
    """Whether there is no recent usable epoch."""
    epoch = light.epoch
    return epoch is None or light.filter.course.t_mono - epoch.t_end > SILENT_S or bool(epoch.block & UNUSABLE)


def too_strong_at(light: LightChannel | None, T_map_base: Array) -> list[bool]:
    """For each received lamp, whether its RSS is larger than possible near a pose (x, y, yaw; map frame).

    It reads the latest epoch only. The filter may have diverged with wrong odometry, and RSS does not depend on the
    heading. Of lamps of one code the nearest counts. Empty without a usable epoch.
    """
    if light is None or silent(light):
        return []
    lights, epoch = light.filter, light.epoch
    assert epoch is not None
    rx = lights.survey.receiver
    (x, y) = se2.apply(T_map_base, np.array(((rx.x, rx.y),)))[0].tolist()
    return strong_at(lights, epoch, x, y)
