"""The bounded recent map a scan is matched against: the last keyframes' points on one distance-region axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator import se2
from estimator.distance_region import Axis, build_axis
from estimator.records import Array, Scan
from estimator.scanpoints import ScanPoints, lines_of


@dataclass(slots=True, eq=False)
class Keyframe:
    """A scan kept.

    Attributes:
        T_map_keyframe: follows every correction of the map. T_odom_keyframe: where it was laid, never changes.
        lines: line elements in the keyframe's base frame. scan: the beams, for the occupancy grid.
    """

    key: int
    T_map_keyframe: Array
    T_odom_keyframe: Array
    lines: Array
    scan: Scan


@dataclass(slots=True, eq=False)
class LocalMap:
    """Line elements of the recent keyframes, indexed; ``lines`` (normal x, y, variance) in the order of the rows."""

    axis: Axis
    lines: Array


def keyframe_of(key: int, T_map: Array, T_odom: Array, points: ScanPoints, scan: Scan) -> Keyframe:
    """Make a keyframe from the scan just matched."""
    return Keyframe(key, T_map, T_odom, lines_of(points), scan)


def build(keyframes: list[Keyframe], origin: Array) -> LocalMap:
    """Index the given keyframes around ``origin`` (the lidar's place in the odom frame)."""
    xy = np.concatenate([se2.apply(k.T_odom_keyframe, k.lines[:, :2]) for k in keyframes])
    turned = [k.lines[:, 2:4] @ se2.rotation(k.T_odom_keyframe[2])[:2, :2].T for k in keyframes]
    slope = np.concatenate([k.lines[:, 4] for k in keyframes])
    axis = build_axis(xy, origin)
    return LocalMap(axis, np.column_stack((np.concatenate(turned), slope))[axis.label])
