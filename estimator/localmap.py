"""The bounded recent map a scan is matched against: the last keyframes' points on one distance-region axis."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimator import se2
from estimator.distance_region import Axis, build_axis
from estimator.records import Array, Scan
from estimator.scanpoints import ScanPoints, normals_of


@dataclass(slots=True, eq=False)
class Keyframe:
    """A scan kept.

    Attributes:
        T_map_keyframe: follows every correction of the map. T_odom_keyframe: where it was laid, never changes.
        xy, normals: surface points in the keyframe's base frame. scan: the beams, for the occupancy grid.
    """

    key: int
    T_map_keyframe: Array
    T_odom_keyframe: Array
    xy: Array
    normals: Array
    scan: Scan


@dataclass(slots=True, eq=False)
class LocalMap:
    """Points of the recent keyframes, indexed. normals are in the order of the axis' rows."""

    axis: Axis
    normals: Array


def keyframe_of(key: int, T_map: Array, T_odom: Array, points: ScanPoints, scan: Scan) -> Keyframe:
    """Make a keyframe from the scan just matched."""
    normals = normals_of(points)
    line = normals.any(axis=1)
    return Keyframe(key, T_map, T_odom, points.xy[line], normals[line], scan)


def build(keyframes: list[Keyframe], origin: Array) -> LocalMap:
    """Index the given keyframes around ``origin`` (the lidar's place in the odom frame)."""
    xy = np.concatenate([se2.apply(k.T_odom_keyframe, k.xy) for k in keyframes])
    turned = [k.normals @ se2.rotation(k.T_odom_keyframe[2])[:2, :2].T for k in keyframes]
    axis = build_axis(xy, origin)
    return LocalMap(axis, np.ascontiguousarray(np.concatenate(turned)[axis.label]))
