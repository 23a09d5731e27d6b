"""``lumiloop map export|render|import``: converts a map file to other formats, and a map_server map to a map file."""

from __future__ import annotations

import argparse
import secrets
import sys
import time

import numpy as np

from daemon.maps.carmen import carmen
from daemon.maps.container import BadMap
from daemon.maps.edit import LONGEST_NAME, Refused, called, keep, put
from daemon.maps.grid_files import map_yaml, pgm
from daemon.maps.image import image_from, meta_of, packed
from daemon.maps.image_geometry import grid_of, lamps_of, placed
from daemon.maps.map_drawing import near, picture
from daemon.maps.png import encode_png
from daemon.replay.results import Folder, OutputRefused, Trajectory, tum
from daemon.system import console
from daemon.system.versions import release
from estimator import Array, Identity, MapImage, image_of_cells


def export(args: argparse.Namespace) -> int:
    """Writes the requested formats of a map file; returns the exit code."""
    try:
        image = image_from(args.stored)
        folder = Folder(args.out)
        frames = placed(image)
        written: list[str] = []
        if args.pgm or not (args.tum or args.carmen):
            grid = grid_of(image)
            drawn = encode_png(picture(near(grid, _driven(image), args.margin), np.zeros((0, 3)), lamps_of(image)))
            files = [("map.pgm", pgm(grid)), ("map.yaml", map_yaml(grid, "map.pgm")), ("map.png", drawn)]
            folder.write_each(files)
            written += [name for name, _ in files]
        if args.tum:
            stamps = np.array([frame.key for frame, _ in frames], dtype=np.float64)
            folder.write("keyframes.tum", tum(Trajectory(stamps, np.array([T for _, T in frames]).reshape(-1, 3))))
            written.append("keyframes.tum")
        if args.carmen:
            scans = ((frame.key, T, frame.T_base_lidar, frame.beams()) for frame, T in frames)
            folder.write("keyframes.clf", carmen(scans))
            written.append("keyframes.clf")
    except (BadMap, OutputRefused, OSError) as error:
        return console.fail(str(error))
    sys.stdout.write(f"{args.out}: {', '.join(written)}\n")
    return console.OK


def render(args: argparse.Namespace) -> int:
    """Writes an image of a map file; returns the exit code."""
    try:
        image = image_from(args.stored)
        part = near(grid_of(image), _driven(image), args.margin)
        pixels = picture(part, np.zeros((0, 3)), lamps_of(image))
        Folder(args.out.parent).write(args.out.name, encode_png(pixels))
    except (BadMap, OutputRefused, OSError) as error:
        return console.fail(str(error))
    sys.stdout.write(f"{args.out}: {pixels.shape[1]} x {pixels.shape[0]} pixels\n")
    return console.OK


def _driven(image: MapImage) -> Array:
    """(n, 3) poses of the keyframes in the map frame."""
    return np.array([T for _, T in placed(image)]).reshape(-1, 3)


def take_in(args: argparse.Namespace) -> int:
    """Makes a map file of a map_server map; returns the exit code."""
    try:
        described, cells = args.described
        named = called(args.name) if args.name else args.yaml.stem[:LONGEST_NAME]
        identity = Identity(1 + secrets.randbelow(2**32 - 1), named)
        origin = np.array(described.origin)
        image = image_of_cells(cells, described.resolution, origin, identity)
        content = packed(image, meta_of(image, time.time(), "", release()))
        path = keep(args.settings, content, identity.map_id) if args.out is None else put(args.out, content)
    except (BadMap, Refused, OSError) as error:
        return console.fail(str(error))
    except ValueError as error:
        return console.fail(f"{args.yaml}: {error}")
    wide, tall = cells.shape[1] * described.resolution, cells.shape[0] * described.resolution
    sys.stdout.write(f"{path}: map {identity.map_id:08x} of {wide:.1f} x {tall:.1f} m, {len(image.submaps)} submaps\n")
    return console.OK
