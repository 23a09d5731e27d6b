"""Inputs of the commands that use the estimator's kernels: opened and judged before a kernel is compiled.

Compiling takes a minute or more at the first start, and an input that cannot be used needs none. Each function stores
what it has opened in the arguments, for the command's body.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from daemon.config.paths import SERVICE_STATE, recordings_folder
from daemon.diagnosis.recorded_spans import NoMoment, find, is_folder, spans
from daemon.maps.container import MAGIC, BadMap
from daemon.maps.edit import opened
from daemon.maps.map_server import BadMapServer, load
from daemon.replay.sources import MCAP_MAGIC, open_log
from hal.errors import HalError
from hal.replay.text import head

FLIGHT = "flight"
"""Folder of recordings if none is named, below our state directory or else the service's."""

MOST_FREE_M2 = 50_000.0
"""Free area of an imported map, m^2. It costs about 1 ms and 65 kB per square metre."""

REFUSALS = (HalError, BadMap, BadMapServer, NoMoment, OSError)
"""Errors of an input that cannot be used; each text names the input and the remedy."""


def log(args: argparse.Namespace) -> None:
    """Opens the log ``args.log`` as ``args.source``."""
    args.source = open_log(args.log)


def log_or_map(args: argparse.Namespace) -> None:
    """Opens ``args.log``: a map file as ``args.stored``, any other as ``args.source``; the other one is None."""
    args.stored = args.source = None
    if _is_map(args.log):
        args.stored = opened(args.log)
    else:
        log(args)


def log_or_mcap(args: argparse.Namespace) -> None:
    """Opens ``args.log`` as ``args.source``; None for an MCAP file, which is not replayed."""
    args.source = None
    if args.log.is_dir() or not head(args.log).startswith(MCAP_MAGIC):
        log(args)


def map_file(args: argparse.Namespace) -> None:
    """Opens the map file ``args.map`` as ``args.stored``."""
    args.stored = opened(args.map)


def map_server(args: argparse.Namespace) -> None:
    """Reads the map_server map ``args.yaml`` as ``args.described``."""
    described, cells = load(args.yaml)
    area = float((cells == 0).sum()) * described.resolution**2
    if area > MOST_FREE_M2:
        raise BadMapServer(
            f"{args.yaml}: the map has {area:.0f} m2 of free ground; at most {MOST_FREE_M2:.0f} can be imported"
        )
    args.described = described, cells


def moment(args: argparse.Namespace) -> None:
    """Finds the recording with the moment ``args.time`` in ``args.log``, as ``args.found``."""
    folder = args.log or recordings_folder(FLIGHT)
    if args.log is None and not is_folder(folder):
        looked = f"no recording was found in {folder} or {SERVICE_STATE / FLIGHT}"
        raise NoMoment(f"{looked}; name a recording, or start the daemon with --record {folder} --last 10")
    args.found = find(spans(folder), args.time, folder)


def _is_map(path: Path) -> bool:
    """True if it is a map file; an unreadable file is judged by its name."""
    try:
        with path.open("rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return path.suffix == ".lumimap"
