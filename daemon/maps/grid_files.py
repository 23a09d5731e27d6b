"""Occupancy grid export: PGM and YAML (map_server), and a PNG with trajectory and lamps."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.maps import map_drawing
from daemon.maps.map_server import FREE, OCCUPIED
from daemon.maps.png import encode_png
from estimator import Array, Grid

RESOLUTIONS_M: Final = (0.05, 0.1, 0.2, 0.5, 1.0)
"""Metres per cell of an exported map."""
_UNKNOWN_GREY: Final = 205
_FREE_GREY: Final = 254
_WALL_GREY: Final = 0


def finest(draw: Callable[[float], Grid]) -> Grid:
    """Grid at the finest of :data:`RESOLUTIONS_M` that its extent permits; ``draw`` raises `ValueError` otherwise."""
    for resolution in RESOLUTIONS_M[:-1]:
        try:
            return draw(resolution)
        except ValueError:
            continue
    return draw(RESOLUTIONS_M[-1])


def greys(grid: Grid) -> npt.NDArray[np.uint8]:
    """Trinary pixels of a map, top row (largest y) first: 0 occupied, 254 free, 205 unknown."""
    probability = grid.probability[::-1]
    pixels = np.full(probability.shape, _UNKNOWN_GREY, np.uint8)
    pixels[probability > OCCUPIED] = _WALL_GREY
    pixels[probability < FREE] = _FREE_GREY
    return pixels


def pgm(grid: Grid) -> bytes:
    """Binary PGM of a map as map_server reads it; an empty map is one unknown cell."""
    pixels = greys(grid)
    if pixels.size == 0:
        pixels = np.full((1, 1), _UNKNOWN_GREY, np.uint8)
    rows, columns = pixels.shape
    return f"P5\n{columns} {rows}\n255\n".encode() + pixels.tobytes()


def map_yaml(grid: Grid, image: str) -> bytes:
    """map_server YAML description: image by relative path, origin the lower left corner of the lower left pixel."""
    x, y = (float(value) + 0.0 for value in grid.origin)
    lines = (
        f"image: {image}",
        "mode: trinary",
        f"resolution: {grid.resolution:.6g}",
        f"origin: [{x:.6f}, {y:.6f}, 0.0]",
        "negate: 0",
        f"occupied_thresh: {OCCUPIED}",
        f"free_thresh: {FREE}",
    )
    return ("\n".join(lines) + "\n").encode()


def map_files(
    grid: Grid, path: Array, lamps: Array | None = None, margin_m: float | None = None
) -> list[tuple[str, bytes]]:
    """map.pgm, map.yaml and map.png by name.

    ``path``: (n, 2 or more) m. ``lamps``: (k, 3) positions in m and numbers. ``margin_m``: of map.png, about the path.
    """
    return [
        ("map.pgm", pgm(grid)),
        ("map.yaml", map_yaml(grid, "map.pgm")),
        ("map.png", encode_png(map_drawing.picture(map_drawing.near(grid, path, margin_m), path, lamps))),
    ]
