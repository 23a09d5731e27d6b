"""A hybrid world: a real log's scans come out of a fake HOKUYO as if a sensor had just measured them.

What the log says is passed on bit for bit; what it does not say (a sensor's geometry in whole steps, its rhythm) is
stated by a model made to measure. A reference trajectory of the log is the ground truth; lamps are to be placed
along it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from hal.fake.lidar.models import ECHOES, UTM_30LX, LidarModel
from hal.fake.lidar.rotor import TimetableRotor
from hal.fake.lidar.scan import FakeScan
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry
from tools.sim.building.world import Array


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Poses (n, 3) of base_link at rising times (n,), interpolated in between and held beyond the ends."""

    t_mono: Array
    poses: Array

    def at(self, t_mono: Array) -> Array:
        """(m, 3) poses at (m,) times."""
        yaw = np.unwrap(self.poses[:, 2])
        columns = (self.poses[:, 0], self.poses[:, 1], yaw)
        return np.column_stack([np.interp(t_mono, self.t_mono, column) for column in columns])


class HybridScene:
    """A :class:`tools.sim.scene.Scene` made from records of a log.

    Args:
        records: scans and odometry as any player of :mod:`hal.replay` yields them, all scans of one geometry.
        reference: where the robot really was, on the records' clock; without one the truth is the log's own odometry.
        mount: where the laser sat on the robot, (x, y, yaw) in m and rad.
        even: pass the scans on in an even rhythm, as a motor gives it, and stretch the time of everything else with
            them. Without it the sensor keeps the log's own stamps, and a driver will rightly distrust a sensor whose
            turns take now half and now twice their time, as many a log has it.

    Raises:
        ValueError: no scans, scans of several shapes, or a geometry that whole steps cannot state.
    """

    def __init__(
        self,
        records: Iterable[RawScan | RawOdometry],
        reference: Trajectory | None = None,
        mount: tuple[float, float, float] = (0.0, 0.0, 0.0),
        even: bool = True,
    ) -> None:
        self.mount = mount
        scans: list[RawScan] = []
        odometry: list[RawOdometry] = []
        for record in records:
            if isinstance(record, RawScan):
                scans.append(record)
            else:
                odometry.append(record)
        stamps = _rising(scans)
        self._starts = np.linspace(stamps[0], stamps[-1], len(stamps)) if even else stamps
        self._words = [_words(scan) for scan in scans]
        self._intensity = [scan.intensity for scan in scans]
        readings = Trajectory(
            np.array([reading.t_mono for reading in odometry]),
            np.array([(reading.x, reading.y, reading.yaw) for reading in odometry]).reshape(-1, 3),
        )
        self._odometry = _stretched(readings, stamps, self._starts)
        self._reference = self._odometry if reference is None else _stretched(reference, stamps, self._starts)
        self.model = fitted_model(scans[0], _turn(scans[0].geometry, self._starts))
        self._starts = self._starts - self.model.amin * self.model.true_period_s / self.model.ares

    @property
    def starts(self) -> Array:
        """When the sensor passed step 0 of each scan, on the records' clock."""
        return self._starts

    def rotor(self) -> TimetableRotor:
        """A motor that turns when the scans were measured."""
        return TimetableRotor(self._starts.tolist(), self.model.true_period_s)

    def scan(self, t_mono: float) -> FakeScan | None:
        """The log's scan that began last at ``t_mono``; None before the first and a period after the last."""
        if t_mono > self._starts[-1] + self.model.true_period_s:
            return None
        index = int(np.searchsorted(self._starts, t_mono + 1e-6, side="right")) - 1
        if index < 0:
            return None
        padding = self.model.amin
        intensity = self._intensity[index]
        return FakeScan(
            np.pad(self._words[index], (padding, 0)),
            None if intensity is None else np.pad(intensity, (padding, 0)),
        )

    def odometry_after(self, t_mono: float) -> tuple[float, Array] | None:
        """See :class:`tools.sim.scene.Scene`."""
        index = int(np.searchsorted(self._odometry.t_mono, t_mono, side="right"))
        if index >= len(self._odometry.t_mono):
            return None
        return float(self._odometry.t_mono[index]), self._odometry.poses[index]

    def truth(self, t_mono: Array) -> Array:
        """See :class:`tools.sim.scene.Scene`; raises ValueError where the log has neither reference nor odometry."""
        if not len(self._reference.t_mono):
            raise ValueError("the log carries no odometry and no reference trajectory was given: there is no truth")
        return self._reference.at(t_mono)


def _rising(scans: list[RawScan]) -> Array:
    if not scans:
        raise ValueError("the log has no scans, so there is nothing to drive a lidar with")
    odd = {len(scan.ranges) for scan in scans} - {len(scans[0].ranges)}
    if odd:
        raise ValueError(f"scans of {len(scans[0].ranges)} and of {sorted(odd)} beams: one sensor has one geometry")
    starts = np.array([scan.t_mono for scan in scans])
    if np.any(np.diff(starts) <= 0.0):
        raise ValueError("scan times do not rise; play the log through hal.replay, which mends its stamps")
    return starts


def _stretched(trajectory: Trajectory, stamps: Array, starts: Array) -> Trajectory:
    """The same poses at the times to which the scans around them have moved."""
    t = trajectory.t_mono
    inside = np.interp(t, stamps, starts)
    return Trajectory(np.where(t < stamps[0], t, np.where(t > stamps[-1], t, inside)), trajectory.poses)


def _turn(geometry: LidarGeometry, starts: Array) -> float:
    """Seconds a turn takes: by the log's own beam times, else by its rhythm."""
    if geometry.beam_dt_s > 0.0:
        return float(geometry.beam_dt_s * geometry.ares)
    return float(np.median(np.diff(starts))) if len(starts) > 1 else geometry.period_s


def _words(scan: RawScan) -> npt.NDArray[np.int32]:
    """What the device had said: the distance in mm, or the raw value that was none."""
    if abs(scan.geometry.range_unit_m - 0.001) > 1e-12:
        raise ValueError(f"ranges in units of {scan.geometry.range_unit_m} m; a SCIP sensor speaks millimetres")
    return np.where(scan.code == VALID, scan.ranges, scan.code).astype(np.int32)


def fitted_model(scan: RawScan, period_s: float) -> LidarModel:
    """A sensor of the same beams: whole steps a turn, the front at a whole step.

    Raises:
        ValueError: the beams do not fall on whole steps (more than 1/1000 of a step off).
    """
    geometry = scan.geometry
    ares, afrt = round(geometry.ares / scan.stride), _front(geometry, scan)
    off = abs(geometry.ares / scan.stride - ares) * len(scan.ranges) / ares
    front = round(afrt)
    if max(off, abs(afrt - front)) > 1e-3:
        raise ValueError(f"beams of {geometry.model} do not fall on whole steps: {geometry.ares} a turn, front {afrt}")
    amin = max(-front, 0)
    return replace(
        UTM_30LX,
        modl=f"HYBRID[{geometry.model}]",
        prod="Recorded log as a sensor",
        dmin=geometry.dmin,
        dmax=geometry.dmax,
        ares=ares,
        amin=amin,
        amax=amin + len(scan.ranges) - 1,
        afrt=front + amin,
        rpm=max(round(60.0 / period_s), 1),
        true_period_s=period_s,
        measures=ECHOES,
    )


def _front(geometry: LidarGeometry, scan: RawScan) -> float:
    """Front step counted from the first beam, in beams."""
    return (geometry.afrt - scan.first_step - 0.5 * (scan.stride - 1)) / scan.stride
