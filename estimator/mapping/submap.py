"""Submaps: stretches of the way whose inner shape is taken for settled; what the pose graph moves as one piece."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from estimator.mapping.keyframe import Keyframe, Settled
from estimator.measurements import Beam
from estimator.numerics import se2
from estimator.numerics.arrays import Array
from estimator.scan_matching import local_map
from estimator.scan_matching.deskew import ScanPoints
from estimator.scan_matching.line_features import lines_of
from estimator.scan_matching.local_map import MapSettings

SIZE = 12
"""Keyframes in a submap: some three metres of way."""


def settle(frames: Sequence[Keyframe], T_odom_submap: Array, sigma: float) -> Settled:
    """Merge the lines of keyframes (at least one) into one submap whose frame lay at ``T_odom_submap``."""
    local = local_map.empty(np.zeros(2))
    placed = [replace(frame, T_odom_keyframe=se2.between(T_odom_submap, frame.T_odom_keyframe)) for frame in frames]
    for frame in placed:
        lines = lines_of(points_of_frame(frame, sigma))
        local = local_map.update(local, frame, lines, MapSettings(age=len(placed) + 1), sigma)
    return Settled(local.elements.astype(np.float32), placed[len(placed) // 2], sigma)


def points_of_frame(frame: Keyframe, sigma: float) -> ScanPoints:
    """Surface points of a keyframe in its base frame."""
    bearing, distance, kind = frame.beams()
    hit = (kind == Beam.HIT) & np.isfinite(distance) & (distance > 0.0)
    angle, reach = bearing[hit] + frame.T_base_lidar[2], distance[hit]
    xy = np.column_stack((reach * np.cos(angle), reach * np.sin(angle))) + frame.T_base_lidar[:2]
    return ScanPoints(np.ascontiguousarray(xy), np.ascontiguousarray(frame.T_base_lidar[:2]), 0.0, sigma)
