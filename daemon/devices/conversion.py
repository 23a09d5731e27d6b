"""Conversion of device readings to SI: lidar steps, range units and device clocks to metres, frames and t_mono.

No other module converts device units. A range keeps three possible meanings: a distance, nothing up to a limit, or no
information.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.config.schema import LidarConfig
from estimator import Array, Beam, Imu, Odometry, Profile, SampleBlock, Scan, se2
from hal.adc import Blemish, RawSamples
from hal.imu import RawImu
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry


@dataclass(frozen=True, slots=True)
class RangeFacts:
    """Range properties of a lidar model from its data sheet, which the device itself does not report.

    Attributes:
        sigma_m: one-sigma repeatability over the range that matters indoors.
        free_m: range up to which even a dark surface (10 % diffuse reflectance) returns an echo, so that "no return"
            means free space; 0 where the data sheet does not guarantee it.
    """

    sigma_m: float
    free_m: float = 0.0


FACTS: Final[tuple[tuple[str, RangeFacts], ...]] = (
    (r"UST-20LX", RangeFacts(0.03, 8.0)),
    (r"UST-", RangeFacts(0.03, 4.0)),
    (r"UTM-30LX|UXM-30LX", RangeFacts(0.01)),
    (r"URG-04LX|UBG-04LX", RangeFacts(0.01)),
    (r"UHG-08LX", RangeFacts(0.02)),
)
"""By model name as the device reports it; HOKUYO data sheets, "repeated accuracy" and "detection range"."""
UNKNOWN_MODEL: Final = RangeFacts(0.02)


def range_facts(model: str) -> RangeFacts:
    """Range properties of a model; cautious ones for a model without an entry."""
    return next((facts for pattern, facts in FACTS if re.search(pattern, model)), UNKNOWN_MODEL)


@dataclass(frozen=True, slots=True, eq=False)
class _Sweep:
    """Arrays that are the same for every scan of one geometry."""

    bearing_rad: Array
    unmasked: npt.NDArray[np.bool_]
    duration_s: float
    facts: RangeFacts


class ScanBridge:
    """Converts raw scans to SI scans; its only state is arrays derived from configuration and geometry."""

    def __init__(self, config: LidarConfig) -> None:
        mount = config.mount
        self._config = config
        self._sweeps: dict[tuple[LidarGeometry, int, int, int], _Sweep] = {}
        self.T_base_lidar = np.array((mount.x, mount.y, math.radians(mount.yaw)))
        """Mount of the lidar on the robot; a log's own mount may replace it before the first scan."""

    def scan(self, raw: RawScan) -> Scan:
        """The scan in SI units, with mount, inversion, mask and the meaning of the range codes applied."""
        sweep = self._sweep(raw)
        unit = raw.geometry.range_unit_m
        range_m: Array = raw.ranges * np.float64(unit)
        hit = (raw.code == VALID) & sweep.unmasked
        hit &= range_m >= self._config.mask.near
        beam = hit.view(np.uint8)  # HIT or NONE
        if sweep.facts.free_m > 0.0:
            free = (raw.code > raw.geometry.dmax) & sweep.unmasked
            beam[free] = Beam.FREE
            range_m[free] = sweep.facts.free_m
        return Scan(
            t_begin=raw.t_mono,
            t_end=raw.t_mono + sweep.duration_s,
            seq=raw.seq,
            T_base_lidar=self.T_base_lidar,
            bearing_rad=sweep.bearing_rad,
            range_m=range_m,
            beam=beam,
            sigma_m=sweep.facts.sigma_m,
            intensity=None if raw.intensity is None else raw.intensity.astype(np.float64),
        )

    def _sweep(self, raw: RawScan) -> _Sweep:
        key = (raw.geometry, raw.first_step, raw.stride, len(raw.ranges))
        if key not in self._sweeps:
            self._sweeps = {key: self._make_sweep(*key)}
        return self._sweeps[key]

    def _make_sweep(self, geometry: LidarGeometry, first_step: int, stride: int, count: int) -> _Sweep:
        bearing = geometry.bearings(first_step, stride, count)
        unmasked = np.ones(count, dtype=bool)
        for begin, end in self._config.mask.sectors:
            unmasked &= ~in_sector(np.degrees(bearing), begin, end)
        if self._config.mount.inverted:
            bearing = -bearing  # the lidar is mounted upside down, rotated about its front axis
        duration = geometry.beam_dt_s * stride * max(0, count - 1)
        return _Sweep(bearing, unmasked, duration, range_facts(geometry.model))


def in_sector(bearing_deg: Array, begin: float, end: float) -> npt.NDArray[np.bool_]:
    """Mask of the bearings in the sector counter-clockwise from ``begin`` to ``end``, ends included; all in degrees."""
    if abs(end - begin) >= 360.0:
        return np.ones(len(bearing_deg), dtype=bool)
    slack = 1e-9  # a bearing equal to an end must not be lost to rounding
    return np.asarray((bearing_deg - begin + slack) % 360.0 <= (end - begin) % 360.0 + 2.0 * slack)


Reading = tuple[float, Array]
"""Stamp (s) of cumulative odometry, and its pose (x, y, yaw; m, m, rad)."""
Amount = tuple[float, float]
"""Length (m) and angle (rad) of a motion; or per second."""


class OdometryBridge:
    """Converts cumulative odometry to increments of the base; a wrong reading, or a new origin, is no motion.

    Stamps are already on our clock (`RawOdometry.t_mono`); a stamp in the future is limited to the time of arrival.
    A reading that speed and acceleration do not explain from the last good reading is in doubt, and gives no increment.
    If they explain a later one from the last good reading, those between were wrong. If that does not happen within
    :data:`DOUBT_S`, the wheels did move so, or the sender has a new origin where no robot is so fast.

    Attributes:
        jumps: number of new origins. invalid: number of readings that are no numbers.
    """

    FASTEST: Final = (5.0, 10.0)
    """Faster than any indoor robot, m/s and rad/s."""
    ACCELERATION: Final = (5.0, 6.0)
    """Largest acceleration of wheels that do not slip, m/s^2 (half of gravity) and rad/s^2."""
    FLOOR: Final = (0.2, 0.2)
    """Motion, m and rad, that jitter of stamps explains: 0.1 s of it at 2 m/s, or at 2 rad/s."""
    JUMP: Final = (0.3, 0.6)
    """Smallest jump of the sender, m and rad, beyond the fastest motion."""
    LONGEST_S: Final = 2.0
    """Longest interval in s that extends the permitted motion: a restart of the sender after a pause must still be
    detected."""
    DOUBT_S: Final = 0.5
    """Longest doubt, s: for so long the estimator extrapolates the pose without odometry."""
    MEAN_S: Final = 0.1
    """Shortest interval, s, of a speed: over a shorter one, jitter of stamps dominates."""

    def __init__(self) -> None:
        self.jumps = 0
        self.invalid = 0
        self._last: Reading | None = None
        self._doubtful: Reading | None = None  # the latest one
        self._t_doubt = 0.0  # arrival of the first: stamps may stand still
        self._since: Reading | None = None
        self._speed: Amount = (0.0, 0.0)

    def increment(self, raw: RawOdometry) -> Odometry | None:
        """Motion since the last good reading; None for the first one, and for one in doubt."""
        if not all(map(math.isfinite, (raw.t_mono, raw.x, raw.y, raw.yaw))):
            self.invalid += 1
            return None
        reading = min(raw.t_mono, raw.t_rx), np.array((raw.x, raw.y, raw.yaw))
        if self._last is None:
            self._last = self._since = reading
            return None
        moved, seconds = amount(self._last, reading), min(max(0.0, reading[0] - self._last[0]), self.LONGEST_S)
        if not self._explained(moved, seconds):
            if self._doubtful is None:
                self._t_doubt = raw.t_rx
            if self._doubtful is None or raw.t_rx - self._t_doubt < self.DOUBT_S:
                self._doubtful = reading
                return None
            if not within(moved, self.JUMP, self.FASTEST, seconds):
                self.jumps += 1
                self._last = self._since = self._doubtful
                self._speed = (0.0, 0.0)
        return self._accept(self._last, reading)

    def _explained(self, moved: Amount, seconds: float) -> bool:
        """Whether the robot's speed and acceleration allow a motion; it may always be slower, or stop."""
        v, w = (
            min(speed + acceleration * seconds, most)
            for speed, acceleration, most in zip(self._speed, self.ACCELERATION, self.FASTEST, strict=True)
        )
        return within(moved, self.FLOOR, (v, w), seconds)

    def _accept(self, before: Reading, after: Reading) -> Odometry:
        t_end = max(before[0], after[0])  # stamps may run backwards; the motion is real all the same
        self._last, self._doubtful = (t_end, after[1]), None
        if self._since is not None and (seconds := t_end - self._since[0]) >= self.MEAN_S:
            far, turned = amount(self._since, after)
            self._speed, self._since = (far / seconds, turned / seconds), self._last
        return Odometry(before[0], t_end, se2.between(before[1], after[1]))


def amount(before: Reading, after: Reading) -> Amount:
    """Length and angle of the motion between two readings."""
    (x0, y0, yaw0), (x1, y1, yaw1) = before[1].tolist(), after[1].tolist()
    return math.hypot(x1 - x0, y1 - y0), abs(se2.wrap(yaw1 - yaw0))


def within(moved: Amount, floor: Amount, speed: Amount, seconds: float) -> bool:
    """Whether a motion is at most ``floor``, and ``speed`` for a time."""
    return moved[0] <= floor[0] + speed[0] * seconds and moved[1] <= floor[1] + speed[1] * seconds


class ImuBridge:
    """Converts yaw rates to the angle turned between two readings (trapezoid rule)."""

    LONGEST_S: Final = 0.2
    """Longest gap between readings in s; a rotation in a longer gap was not measured."""

    def __init__(self) -> None:
        self.invalid = 0
        self._last: tuple[float, float] | None = None

    def turn(self, raw: RawImu) -> Imu | None:
        """Angle turned since the last reading; None for the first reading, and after a gap."""
        if not (math.isfinite(raw.yaw_rate) and math.isfinite(raw.t_mono)):
            self.invalid += 1
            return None
        now = min(raw.t_mono, raw.t_rx)
        last, self._last = self._last, (now, raw.yaw_rate)
        if last is None or not 0.0 < now - last[0] <= self.LONGEST_S:
            return None
        return Imu(last[0], now, 0.5 * (last[1] + raw.yaw_rate) * (now - last[0]))


UNFIT: Final = Blemish.SHORT | Blemish.MISALIGNED | Blemish.STUCK
"""Flags of blocks that do not represent the light; the decoder judges all others."""

MEASURED: Final = 2e-3
"""Relative accuracy of a driver's measured rate. Within this margin beyond the decoder's range, the decoder decides."""


class SampleBridge:
    """Converts a converter's blocks to blocks at the nominal rate of the air interface, each with its own time base.

    The decoder searches the sample clock around the nominal rate, so every block is given that rate. A converter
    outside the decoder's range keeps its own rate, and :attr:`off_rate` is set.

    Attributes:
        unfit, dead, stretched: blocks dropped for their words, those of them in which all words are equal, and blocks
            whose samples may not be evenly spaced.
        rate_hz: conversions per second of the latest block as measured, 0 before the first.
    """

    def __init__(self, profile: Profile) -> None:
        self.unfit = self.dead = self.stretched = 0
        self.rate_hz = 0.0
        self._profile = profile

    @property
    def off_rate(self) -> bool:
        """Whether the converter's clock is so far off that no lamp can be decoded."""
        return self.rate_hz > 0.0 and not self._reachable(self.rate_hz)

    def block(self, raw: RawSamples) -> SampleBlock | None:
        """The block in decoder format; None for words that do not represent the light."""
        if raw.blemish & UNFIT or raw.words.size == 0:
            self.unfit += 1
            self.dead += Blemish.STUCK in raw.blemish
            return None
        self.stretched += Blemish.STRETCHED in raw.blemish
        self.rate_hz = raw.rate_hz
        return SampleBlock(
            t_begin=raw.t_first,
            t_end=raw.t_first + raw.words.size / raw.rate_hz + raw.slack_s,
            words=raw.words.astype(np.float64),
            rate=self._profile.sample_rate if self._reachable(raw.rate_hz) else raw.rate_hz,
        )

    def _reachable(self, rate_hz: float) -> bool:
        off = abs(rate_hz / self._profile.sample_rate - 1.0)
        return off <= 1e-6 * self._profile.clock_ppm + MEASURED
