"""Typed SI records that go into `step`, each with the interval of ``t_mono`` in which it was true.

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

from estimator.cdma.epoch import LightEpoch as LightEpoch  # records too, so they are offered from here
from estimator.cdma.epoch import SampleBlock as SampleBlock
from estimator.numerics import se2
from estimator.numerics.arrays import Array as Array

Beams = tuple[Array, Array, npt.NDArray[np.uint8]]
"""Bearing in the lidar frame (evenly spaced, rad), range (m), kind: what the beam kernels take."""


class Beam(IntEnum):
    """A beam says one of three things (glass and darkness make the third one necessary)."""

    HIT = 1  # there is a surface at `range_m`
    FREE = 2  # nothing up to `range_m`
    NONE = 0  # no statement


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """One revolution of a lidar in SI units. All arrays have one element per beam, in order of measurement.

    Attributes:
        t_begin, t_end: ``t_mono`` of the first and of the last beam; equal when the log does not say.
        T_base_lidar: mount of the lidar on the robot.
        bearing_rad: in the lidar frame, inversion already applied.
        range_m: metres; meaningful where ``beam`` is HIT (surface) or FREE (bound).
        beam: uint8 of :class:`Beam`.
        intensity: device units or None; the Q of the paper's quality filter.
        sigma_m: one-sigma range noise of this kind of device.
        seq: the device's scan counter, so that results can be told apart.
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
        """The part of an increment ``delta``, made over the record's interval, that lies after an instant."""
        dt = self.t_end - self.t_begin
        if not dt > 0.0 or t_mono <= self.t_begin:
            return delta
        return se2.fraction(delta, max(0.0, (self.t_end - t_mono) / dt))


@dataclass(frozen=True, slots=True)
class Imu:
    """Yaw turned over ``[t_begin, t_end]`` according to a gyro, rad."""

    t_begin: float
    t_end: float
    dyaw: float


class Order(Enum):
    """What a person or a PLC may ask of the estimator."""

    SET_POSE = "set_pose"
    RESET = "reset"
    RELOCALISE = "relocalise"
    PAUSE = (
        "pause"  # obeyed by the cycle: it asks for no more than :attr:`DegradationLevel.CARRIED`, and applies no answer
    )
    RESUME = "resume"
    REMEMBERED = "remembered"  # by nobody: the pose that was stored when the run before ended; a witness, no order


@dataclass(frozen=True, slots=True, eq=False)
class Command:
    """An order with the pose it carries, if any (``T_map_base``)."""

    t_begin: float
    order: Order
    T_map_base: Array | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """Work that must not delay a cycle (rendering, later loop search and the pose graph).

    Attributes:
        priority: lower runs first. run: calls nogil kernels in slices of at most 20 ms; returns the answer's payload.
    """

    job_id: int
    priority: int
    run: Callable[[], object]


@dataclass(frozen=True, slots=True)
class Answer:
    """A job's payload, handed back in the cycle in which it is applied (recorded, so that replay repeats it)."""

    t_begin: float
    job_id: int
    payload: object


Record = Scan | SampleBlock | LightEpoch | Odometry | Imu | Command | Answer
"""What `step` takes. Light comes as a photodiode's samples, or decoded already (a foreign log, a link-level run)."""


Lap = Callable[[str], object]
"""Told the name of each part of a step when it has ended: ``lights``, ``match``, ``map``, ``search``. It may look at a
clock; nothing in this room does, and nothing comes back from it."""


def no_lap(part: str) -> None:
    """A :data:`Lap` that nobody looks at."""


class DegradationLevel(IntEnum):
    """How far a step does without: each leaves out what the ones before it leave out, and more."""

    FULL = 0  # everything
    THINNED = 1  # fewer iterations and points: the caps say how many
    NO_MAP = 2  # and no keyframe is laid, no map updated, no job handed out
    CARRIED = 3  # and scans are passed over: lights and odometry carry the pose


@dataclass(frozen=True, slots=True)
class Limits:
    """The time budget of one cycle, already turned into caps; nothing in this room reads a clock.

    Attributes:
        icp_iterations: cap on matching iterations.
        points: cap on query points per match (the scan is thinned evenly above it).
        update_map: whether keyframe and map work may run in this cycle.
        codes: effort for lamps not seen yet, in light codes that could be searched (6 us each with profile A).
        level: what the step leaves out, :class:`DegradationLevel`.
    """

    icp_iterations: int
    points: int
    update_map: bool
    codes: int = 150
    level: int = 0


UNLIMITED: Final = Limits(icp_iterations=50, points=100_000, update_map=True)
"""Caps that never bind; what replay of a foreign log uses."""
