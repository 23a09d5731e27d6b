"""Poses of keyframes, positions of lamps and the occupancy grid of a map image, in the map frame."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np

from daemon.maps.grid_files import finest
from estimator import Array, Beam, Grid, Keyframe, MapImage, Submap, at_once, finished, se2


def placed(image: MapImage) -> list[tuple[Keyframe, Array]]:
    """Keyframes with T_map_keyframe, in order of their numbers."""
    places = {piece.key: piece.T_map_submap for piece in image.submaps}
    found = [(hung.frame, se2.compose(places[hung.submap], hung.T_submap_keyframe)) for hung in image.keyframes()]
    return sorted(found, key=lambda one: one[0].key)


def pieces_of(image: MapImage) -> Iterator[tuple[Submap, list[Keyframe]]]:
    """Submaps, oldest first, each with its keyframes."""
    hung: dict[int, list[Keyframe]] = {}
    for one in image.keyframes():
        hung.setdefault(one.submap, []).append(one.frame)
    for piece in image.submaps:
        if piece.key in hung:
            yield Submap(*piece), hung[piece.key]


def grid_of(image: MapImage) -> Grid:
    """Occupancy grid of the map at the finest resolution that its extent permits."""
    return finest(partial(at_once, list(pieces_of(finished(image)))))


def echoes_of(frame: Keyframe, T_map_keyframe: Array) -> Array:
    """(n, 2) positions in the map frame where beams of a keyframe ended, m."""
    bearing, reach, kind = frame.beams()
    hit = (kind == Beam.HIT) & np.isfinite(reach) & (reach > 0.0)
    x, y, yaw = se2.compose(T_map_keyframe, frame.T_base_lidar)
    angle = bearing[hit] + yaw
    return np.column_stack((x + reach[hit] * np.cos(angle), y + reach[hit] * np.sin(angle)))


def lamps_of(image: MapImage) -> Array | None:
    """(k, 3) positions of the lamps in m, and their numbers; None where the map is not in the survey frame."""
    if not image.identity.surveyed or not image.lamps:
        return None
    return np.array([(lamp.x, lamp.y, lamp.lamp_id) for lamp in image.lamps])
