"""A scan that is kept: compact beams and the place they were seen from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from estimator import se2
from estimator.records import Array, Scan

Beams = tuple[Array, Array, npt.NDArray[np.uint8]]
"""Bearing in the lidar frame (evenly spaced, rad), range (m), kind: what the beam kernels take."""


@dataclass(frozen=True, slots=True, eq=False)
class Virtual:
    """The paper's virtual consistent state components: what light alone said of the place, free of laser and drift.

    Attributes:
        T_map_base, covariance: of the `lights` filter, for the keyframe's instant. accepted: IDs of the lamps used (S).
    """

    T_map_base: Array
    covariance: Array
    accepted: frozenset[int]


@dataclass(slots=True, eq=False)
class Keyframe:
    """A scan kept.

    Attributes:
        T_map_keyframe: follows every correction of the map. T_odom_keyframe: where it was laid, never changes.
        T_base_lidar: mount. bearing_rad: shared with the other keyframes of the same lidar.
        turned_rad: yaw turned from the first to the last beam. range_m: float32. beam: uint8 of `Beam`.
        virtual: what light said, None where it said nothing good.
    """

    key: int
    T_map_keyframe: Array
    T_odom_keyframe: Array
    T_base_lidar: Array
    bearing_rad: Array
    turned_rad: float
    range_m: npt.NDArray[np.float32]
    beam: npt.NDArray[np.uint8]
    virtual: Virtual | None = None

    @property
    def T_odom_lidar(self) -> Array:
        """The lidar when the keyframe was laid."""
        return se2.compose(self.T_odom_keyframe, self.T_base_lidar)

    def beams(self) -> Beams:
        """Beams as seen from the scan's end."""
        return unturned(self.bearing_rad, self.turned_rad), self.range_m.astype(np.float64), self.beam


def unturned(bearing_rad: Array, turned_rad: float) -> Array:
    """Bearings as they would be had the lidar not turned during the scan, seen from its end."""
    n = len(bearing_rad)
    if turned_rad == 0.0 or n < 2:
        return bearing_rad
    return np.asarray(bearing_rad - turned_rad * (1.0 - np.arange(n) / (n - 1)))


def keep(key: int, T_map: Array, T_odom: Array, scan: Scan, turned_rad: float) -> Keyframe:
    """Make a keyframe of a scan matched at ``T_odom``."""
    return Keyframe(
        key=key,
        T_map_keyframe=T_map,
        T_odom_keyframe=T_odom,
        T_base_lidar=scan.T_base_lidar,
        bearing_rad=scan.bearing_rad,
        turned_rad=turned_rad,
        range_m=scan.range_m.astype(np.float32),
        beam=scan.beam,
    )
