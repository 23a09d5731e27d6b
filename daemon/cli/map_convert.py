"""``lumiloop map export|render|import``: a map file as other programs read it, and one made of what they wrote."""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from collections.abc import Iterator
from functools import partial

import numpy as np

from daemon.cli import parser
from daemon.maps.carmen import carmen
from daemon.maps.container import BadMap
from daemon.maps.edit import LONGEST_NAME, Refused, called, keep, opened, put
from daemon.maps.image import image_from, meta_of, packed
from daemon.maps.map_drawing import draw
from daemon.maps.map_server import BadMapServer, load
from daemon.maps.png import encode_png
from daemon.replay.results import Folder, OutputRefused, Trajectory, finest, map_yaml, pgm, tum
from daemon.system.versions import release
from estimator import Array, Grid, Identity, Keyframe, MapImage, Submap, at_once, finished, image_of_cells, se2


def export(args: argparse.Namespace) -> int:
    """Write what is asked for of a map file; returns the exit code."""
    try:
        image = image_from(opened(args.log))
        folder = Folder(args.out)
        frames = placed(image)
        written: list[str] = []
        if args.pgm or not (args.tum or args.carmen):
            grid = grid_of(image)
            picture = encode_png(draw(grid, np.zeros((0, 3)), lamps_of(image)))
            files = [("map.pgm", pgm(grid)), ("map.yaml", map_yaml(grid, "map.pgm")), ("map.png", picture)]
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
        return parser.fail(str(error))
    sys.stdout.write(f"{args.out}: {', '.join(written)}\n")
    return parser.OK


def render(args: argparse.Namespace) -> int:
    """Draw a map file as a picture; returns the exit code."""
    try:
        image = image_from(opened(args.map))
        pixels = draw(grid_of(image), np.zeros((0, 3)), lamps_of(image))
        Folder(args.out.parent).write(args.out.name, encode_png(pixels))
    except (BadMap, OutputRefused, OSError) as error:
        return parser.fail(str(error))
    sys.stdout.write(f"{args.out}: {pixels.shape[1]} x {pixels.shape[0]} pixels\n")
    return parser.OK


def take_in(args: argparse.Namespace) -> int:
    """Make a map file of one of map_server's; returns the exit code."""
    try:
        described, cells = load(args.yaml)
        named = called(args.name) if args.name else args.yaml.stem[:LONGEST_NAME]
        identity = Identity(1 + secrets.randbelow(2**32 - 1), named)
        origin = np.array(described.origin)
        image = image_of_cells(cells, described.resolution, origin, identity)
        content = packed(image, meta_of(image, time.time(), "", release()))
        path = keep(args.settings, content, identity.map_id) if args.out is None else put(args.out, content)
    except (BadMapServer, BadMap, Refused, OSError) as error:
        return parser.fail(str(error))
    except ValueError as error:
        return parser.fail(f"{args.yaml}: {error}")
    wide, tall = cells.shape[1] * described.resolution, cells.shape[0] * described.resolution
    sys.stdout.write(f"{path}: map {identity.map_id:08x} of {wide:.1f} x {tall:.1f} m, {len(image.submaps)} submaps\n")
    return parser.OK


def placed(image: MapImage) -> list[tuple[Keyframe, Array]]:
    """Keyframes with T_map_keyframe, by number."""
    places = {piece.key: piece.T_map_submap for piece in image.submaps}
    found = [(hung.frame, se2.compose(places[hung.submap], hung.T_submap_keyframe)) for hung in image.keyframes()]
    return sorted(found, key=lambda one: one[0].key)


def pieces_of(image: MapImage) -> Iterator[tuple[Submap, list[Keyframe]]]:
    """Submaps, oldest first, with what hangs on each."""
    hung: dict[int, list[Keyframe]] = {}
    for one in image.keyframes():
        hung.setdefault(one.submap, []).append(one.frame)
    for piece in image.submaps:
        if piece.key in hung:
            yield Submap(*piece), hung[piece.key]


def grid_of(image: MapImage) -> Grid:
    """The map at the finest resolution that its extent allows."""
    return finest(partial(at_once, list(pieces_of(finished(image)))))


def lamps_of(image: MapImage) -> Array | None:
    """(k, 2) places of the lamps; None where the map does not lie in their frame."""
    if not image.identity.surveyed or not image.lamps:
        return None
    return np.array([(lamp.x, lamp.y) for lamp in image.lamps])
