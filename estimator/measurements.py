"""Measurement types: the SI records that `step` consumes, each with its interval of ``t_mono``, and caps of a step.

Frames follow REP-103: x forward, y left, yaw counter-clockwise, metres, radians, seconds. ``T_a_b`` maps b coordinates
into a; a planar transform is a float64 array ``(x, y, yaw)``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, IntEnum
from typing import Final

import numpy as np
import numpy.typing as npt

from estimator.cdma.epoch import LightEpoch as LightEpoch  # records too, so they are exported here
from estimator.cdma.epoch import SampleBlock as SampleBlock
from estimator.numerics import se2
from estimator.numerics.arrays import Array as Array

Beams = tuple[Array, Array, npt.NDArray[np.uint8]]
"""Bearing in the lidar frame (evenly spaced, rad), range (m), kind: the input of the beam kernels."""


class Beam(IntEnum):
    """Kind of a beam: surface, free, or no data (which glass and dark surfaces cause)."""

    HIT = 1  # there is a surface at `range_m`
    FREE = 2  # nothing up to `range_m`
    NONE = 0  # no data


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One revolution of a lidar in SI units. All arrays have one element per beam, in order of measurement.

    Attributes:
        t_begin, t_end: ``t_mono`` of the first and of the last beam; equal when the log has only one.
        seq: the device's scan counter.
        T_base_lidar: mount of the lidar on the robot.
        bearing_rad: in the lidar frame, inversion already applied.
        range_m: metres; meaningful where ``beam`` is HIT (surface) or FREE (lower limit).
        beam: uint8 of :class:`Beam`.
        sigma_m: one-sigma range noise of this kind of device.
        intensity: device units or None; the Q of the paper's quality filter.
    """

    t_begin: float
    t_end: float
    seq: int
    T_base_lidar: Array
    bearing_rad: Array
    range_m: Array
    beam: npt.NDArray[np.uint8]
    sigma_m: float
    intensity: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Odometry:
    """Increment of the base pose over ``[t_begin, t_end]``, expressed in the base frame at ``t_begin``."""

    t_begin: float
    t_end: float
    delta: Array  # (dx, dy, dyaw)

    def part_after(self, t_mono: float, delta: Array) -> Array:
        """The part of an increment ``delta`` over the record's interval that lies after an instant."""
        dt = self.t_end - self.t_begin
        if not dt > 0.0 or t_mono <= self.t_begin:
            return delta
        return se2.fraction(delta, max(0.0, (self.t_end - t_mono) / dt))


@dataclass(frozen=True, slots=True)
class Imu:
    """Rotation (rad) over ``[t_begin, t_end]`` by a gyro."""

    t_begin: float
    t_end: float
    dyaw: float


class Order(Enum):
    """Commands of an operator or a PLC to the estimator."""

    SET_POSE = "set_pose"
    RESET = "reset"
    RELOCALISE = "relocalise"
    PAUSE = (
        "pause"  # executed by the cycle: it skips the lidar (:attr:`DegradationLevel.CARRIED`), applies no job result
    )
    RESUME = "resume"
    REMEMBERED = "remembered"  # no operator's: the stored pose of the previous run, as evidence


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """A command with its pose, if any (``T_map_base``)."""

    t_begin: float
    order: Order
    T_map_base: Array | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """Work that must not delay a cycle (rendering, loop search, pose graph).

    Attributes:
        job_id: number, returned with the result.
        priority: lower runs first.
        run: calls nogil kernels in slices of at most 20 ms; returns the payload of the result.
    """

    job_id: int
    priority: int
    run: Callable[[], object]


@dataclass(frozen=True, slots=True)
class Answer:
    """A job result, returned in the cycle that applies it (recorded, so that a replay repeats it)."""

    t_begin: float
    job_id: int
    payload: object


Record = Scan | SampleBlock | LightEpoch | Odometry | Imu | Command | Answer
"""Input of `step`. Light is a block of samples, or an epoch decoded elsewhere (a third-party log, a link-level run)."""


Lap = Callable[[str], object]
"""Called with the name of each part of a step at its end: ``lights``, ``match``, ``map``, ``search``.

It may read a clock; nothing in this package does. Its result is ignored.
"""


def no_lap(part: str) -> None:
    """A :data:`Lap` without effect."""


class DegradationLevel(IntEnum):
    """Degradation level of a step: each level includes the reductions of those before it."""

    FULL = 0  # everything
    THINNED = 1  # fewer iterations and points, by the caps
    NO_MAP = 2  # and no keyframe, no map update, no job
    CARRIED = 3  # and no scan matches: light and odometry give the pose


@dataclass(frozen=True, slots=True)
class Limits:
    """The time budget of one cycle as caps; nothing in this package reads a clock.

    Attributes:
        icp_iterations: cap on matching iterations.
        points: cap on query points per match (the scan is subsampled evenly above it).
        update_map: whether keyframe and map work may run in this cycle.
        codes: effort for lamps not received yet, in codes that could be searched (6 us each with profile A).
        level: degradation level, :class:`DegradationLevel`.
    """

    icp_iterations: int
    points: int
    update_map: bool
    codes: int = 150
    level: int = 0


UNLIMITED: Final = Limits(icp_iterations=50, points=100_000, update_map=True)
"""Caps without effect, for the replay of a third-party log."""
