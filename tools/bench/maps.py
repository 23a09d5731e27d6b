"""The maps of real logs: accuracy, thickness of their walls, time and memory, and pictures; needs ``LUMILOOP_DATA``.

Each log goes through ``lumiloop replay`` in a process of its own, with every setting as shipped; what counts is what
that process has written and used, start and reading included. Pictures go to ``out/bench`` (those of docs/maps.md are
copies): the map as written, the trajectory in blue, where a loop was closed in orange, axes in metres.

**Thickness of walls.** Every ``EVERY``-th scan's points nearer than ``NEAR_M`` are placed by the final trajectory, each
with the normal that its neighbours in the scan give it, turned towards the sensor. Around a point drawn at random, the
points count that lie within ``ALONG_M`` along the wall and ``ACROSS_M`` across it and whose normals are within 30 deg
of its own, so that the two faces of a wall are two walls. If at least ``ENOUGH`` of them, and two scans more than 30 s
apart, are there, and single scans show a flat piece of wall (9 of 10 of them less than ``FLAT_M`` across), the
thickness is the width across that holds the middle 90 % of them. What was moved meanwhile counts as thick.

**As published** are poses of which a place was claimed; guesses (LOST, RELOCATING, AMBIGUOUS) are counted.
"""

import csv
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from daemon.config.schema import LidarConfig
from daemon.devices.conversion import ScanBridge
from daemon.maps.drawing.axes import Entry, framed
from daemon.maps.png import encode_png
from daemon.replay.sources import open_log
from estimator.numerics import se2
from estimator.scan_matching.deskew import oriented, points_of
from hal.lidar import RawScan
from tools.ci.figures import Figure, bounded
from tools.relations import SPLIT_S, evaluate, read_relations, read_tum

Array = npt.NDArray[np.float64]

COMMAND: Final = "LUMILOOP_DATA=... python -m tools.bench maps"
EVERY: Final = 3
NEAR_M: Final = 10.0
ALONG_M, ACROSS_M = 0.15, 0.6
ALIKE: Final = np.cos(np.radians(30.0))
ENOUGH: Final = 20
APART_S: Final = 30.0
FLAT_M: Final = 0.08
SAMPLES: Final = 4000
SAME_STAMP_S: Final = 0.02
_BETWEEN: Final = """
import os, sys
_, status, used = os.wait4(os.posix_spawn(sys.argv[1], sys.argv[1:], os.environ), 0)
print(used.ru_utime + used.ru_stime, used.ru_maxrss)
sys.exit(os.waitstatus_to_exitcode(status) & 0xFF)
"""
PATH, LOOP, KNOWN, BLANK, FILLED = (0, 90, 181), (230, 120, 0), (255, 255, 255), (205, 211, 220), (28, 34, 48)
MARGIN_M: Final = 9.0
"""Shown around the path; beyond are stray beams through windows."""


@dataclass(frozen=True, slots=True)
class Used:
    """What a replay took: seconds of processor time, MB of memory at most."""

    cpu_s: float
    peak_mb: float


def run() -> list[Figure]:
    """Both logs.

    Raises:
        RuntimeError: LUMILOOP_DATA does not name the folder of real logs, or a replay failed.
    """
    data = os.environ.get("LUMILOOP_DATA")
    if not data:
        raise RuntimeError("LUMILOOP_DATA does not name the folder of real logs (see docs/data.md)")
    figures = []
    for name in ("intel", "aces"):
        log = Path(data) / name / f"{name}.clf.gz"
        with tempfile.TemporaryDirectory() as folder:
            used = replayed(log, Path(folder))
            figures += _figures(name, log, Path(folder), used)
            picture(Path(folder), Path("out/bench") / f"map-{name}.png")
    return figures


def replayed(log: Path, out: Path) -> Used:
    """Replay in a process of its own; kernels are loaded once before, so that none is compiled in it."""
    warm = "from daemon.runtime import warmup; warmup.load()"
    waited([sys.executable, "-c", warm])
    return waited([sys.executable, "-m", "daemon", "replay", str(log), "--out", str(out)])


def waited(command: list[str]) -> Used:
    """Run a command and see what it takes.

    A small process in between starts it: a process counts the memory of the one that started it as its own (exec keeps
    the highest resident set so far), and this one is large.

    Raises:
        RuntimeError: the command failed.
    """
    ran = subprocess.run([sys.executable, "-S", "-c", _BETWEEN, *command], stdout=subprocess.PIPE, text=True)
    if ran.returncode != 0:
        raise RuntimeError(f"{' '.join(command[1:])} ended with status {ran.returncode}")
    cpu_s, peak_kb = ran.stdout.splitlines()[-1].split()
    return Used(float(cpu_s), float(peak_kb) / 1024.0)


def _figures(name: str, log: Path, out: Path, used: Used) -> list[Figure]:
    stamps, poses = read_tum(out / "trajectory.tum")
    online = read_tum(out / "online.tum")
    figures = []
    if name == "intel":
        relations = read_relations(log.with_name("intel.relations"))
        for what, told in (("at the end", (stamps, poses)), ("as published", online)):
            whole = evaluate(*told, relations)
            final = what == "at the end"
            t, r, far = whole.translation_m.mean(), whole.rotation_deg.mean(), whole.beyond(SPLIT_S)
            figures += [
                _judged(f"{name}, {what}: translation, all", t, "m", "<= 0.026" if final else ""),
                _judged(f"{name}, {what}: rotation, all", r, "deg", "<= 0.60" if final else ""),
                _judged(f"{name}, {what}: translation beyond 30 s", far.translation_m.mean(), "m"),
            ]
    else:
        reference = read_tum(log.with_name("aces.gmapping_gfs.tum"))
        off = aligned(stamps, poses, *reference)
        live = aligned(*online, *reference)
        figures += [
            _judged(f"{name}, at the end: RMS to the reference", float(np.sqrt((off**2).mean())), "m", "<= 0.5"),
            _judged(f"{name}, as published: RMS to the reference", float(np.sqrt((live**2).mean())), "m"),
        ]
    figures.append(_judged(f"{name}, as published: guesses, left out", len(stamps) - len(online[0]), ""))
    widths = thickness(*placed(log, poses))
    with (out / "loops.csv").open() as file:
        loops = list(csv.DictReader(file))
    closed = int(loops[-1]["counter"]) if loops else 0
    return [
        *figures,
        _judged(f"{name}: loops closed", closed, ""),
        _judged(f"{name}: thickness of walls, median", 1e3 * float(np.median(widths)), "mm"),
        _judged(f"{name}: thickness of walls, 95 %", 1e3 * float(np.percentile(widths, 95)), "mm", "<= 150"),
        _judged(f"{name}: walls measured", len(widths), ""),
        _judged(f"{name}: processor time a scan, all included", 1e3 * used.cpu_s / len(stamps), "ms", "<= 2.5"),
        _judged(f"{name}: memory at most", used.peak_mb, "MB", "<= 300"),
    ]


def _judged(name: str, value: float, unit: str, target: str = "") -> Figure:
    if target:
        return bounded(name, value, unit, target, COMMAND)
    return Figure(name, float(value), unit, command=COMMAND)


def aligned(stamps: Array, poses: Array, at: Array, reference: Array) -> Array:
    """Distances of a trajectory from a reference at the latter's stamps, after the rigid motion that fits best."""
    order = np.argsort(stamps, kind="stable")
    i = order[np.clip(np.searchsorted(stamps[order], at), 0, len(stamps) - 1)]
    same = np.abs(stamps[i] - at) < SAME_STAMP_S
    a, b = poses[i[same], :2], reference[same, :2]
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    C = a.T @ b
    yaw = np.arctan2(C[0, 1] - C[1, 0], C[0, 0] + C[1, 1])
    off = se2.apply(np.array((0.0, 0.0, yaw)), a) - b
    return np.hypot(off[:, 0], off[:, 1])


def placed(log: Path, poses: Array) -> tuple[Array, Array, Array]:
    """Points (n, 2), normals towards the sensor (n, 2) and instants (n,) of every ``EVERY``-th scan.

    Raises:
        RuntimeError: the trajectory is not this log's.
    """
    source = open_log(log)
    bridge = ScanBridge(LidarConfig())
    bridge.T_base_lidar = np.array(source.mount or (0.0, 0.0, 0.0))
    scans = [event for event in source.events() if isinstance(event, RawScan)]
    if len(scans) != len(poses):
        raise RuntimeError(f"{log} has {len(scans)} scans, the trajectory {len(poses)} poses")
    points, normals, times = [], [], []
    for k in range(0, len(scans), EVERY):
        scan = bridge.scan(scans[k])
        seen = points_of(scan, se2.identity(), NEAR_M, 0.0)
        if len(seen.xy) < ENOUGH:
            continue
        rows = oriented(seen, len(seen.xy))
        rows = rows[np.isfinite(rows).all(axis=1) & (np.hypot(rows[:, 2], rows[:, 3]) > 0.5)]
        normal = np.column_stack([-rows[:, 3], rows[:, 2]])
        away = np.sign(np.einsum("ij,ij->i", normal, rows[:, :2] - scan.T_base_lidar[:2]))
        turn = np.array((0.0, 0.0, poses[k, 2]))
        points.append(se2.apply(poses[k], rows[:, :2]))
        normals.append(se2.apply(turn, -away[:, None] * normal))
        times.append(np.full(len(rows), scan.t_end))
    return np.concatenate(points), np.concatenate(normals), np.concatenate(times)


def thickness(points: Array, normals: Array, times: Array, samples: int = SAMPLES) -> Array:
    """Widths, m, of the walls about points drawn at random: see the head of this file."""
    tree = cKDTree(points)
    drawn = np.random.default_rng(0).choice(len(points), min(samples, len(points)), replace=False)
    widths = []
    for k in drawn.tolist():
        near = np.array(tree.query_ball_point(points[k], float(np.hypot(ALONG_M, ACROSS_M))))
        off, n = points[near] - points[k], normals[k]
        across, along = off @ n, off @ np.array((-n[1], n[0]))
        wall = (np.abs(along) < ALONG_M) & (np.abs(across) < ACROSS_M) & (normals[near] @ n > ALIKE)
        if np.count_nonzero(wall) < ENOUGH or np.ptp(times[near[wall]]) <= APART_S:
            continue
        if relief(across[wall], times[near[wall]]) < FLAT_M:
            low, high = np.percentile(across[wall], (5.0, 95.0))
            widths.append(high - low)
    return np.array(widths)


def relief(across: Array, times: Array) -> float:
    """Width across, m, that single scans show, 90 % of them less; 0 where no scan has two points here."""
    order = np.argsort(times, kind="stable")
    first = np.flatnonzero(np.diff(times[order], prepend=-np.inf) > 0.0)
    widths = np.maximum.reduceat(across[order], first) - np.minimum.reduceat(across[order], first)
    several = widths[np.diff(np.append(first, len(order))) > 1]
    return float(np.percentile(several, 90.0)) if len(several) else 0.0


def picture(out: Path, path: Path) -> None:
    """Draw what a replay has written."""
    grid, resolution, origin = read_pgm(out)
    stamps, poses = read_tum(out / "trajectory.tum")
    grid, origin = about(grid, resolution, origin, poses)
    pixels = np.select([(grid < 100)[..., None], (grid > 230)[..., None]], [FILLED, KNOWN], BLANK).astype(np.uint8)
    _mark(pixels, (poses[:, :2] - origin) / resolution, PATH, 0)
    with (out / "loops.csv").open() as file:
        closed = np.array([float(row["stamp"]) for row in csv.DictReader(file)])
    at = [int(np.abs(stamps - stamp).argmin()) for stamp in closed]
    _mark(pixels, (poses[at, :2] - origin) / resolution, LOOP, 2)
    path.parent.mkdir(parents=True, exist_ok=True)
    named = (PATH, "path"), (LOOP, "loop closed"), (FILLED, "wall"), (KNOWN, "free"), (BLANK, "unknown")
    legend = [Entry(np.array(colour, np.float64), text) for colour, text in named]
    path.write_bytes(encode_png(framed(pixels, (float(origin[0]), float(origin[1])), 1.0 / resolution, legend)))


def about(
    grid: npt.NDArray[np.uint8], resolution: float, origin: Array, poses: Array
) -> tuple[npt.NDArray[np.uint8], Array]:
    """The part of a map (rows from the top) around a path, and its lower left corner."""
    size = np.array(grid.shape[::-1])
    low = np.clip(np.floor((poses[:, :2].min(axis=0) - MARGIN_M - origin) / resolution).astype(int), 0, size)
    high = np.clip(np.ceil((poses[:, :2].max(axis=0) + MARGIN_M - origin) / resolution).astype(int), 0, size)
    rows = len(grid)
    return grid[rows - high[1] : rows - low[1], low[0] : high[0]], origin + low * resolution


def _mark(pixels: npt.NDArray[np.uint8], cells: Array, colour: tuple[int, int, int], reach: int) -> None:
    """Squares of ``2 reach + 1`` pixels at (column, row from below)."""
    rows, columns = pixels.shape[:2]
    c = np.floor(cells[:, 0]).astype(int)
    r = rows - 1 - np.floor(cells[:, 1]).astype(int)
    for dr in range(-reach, reach + 1):
        for dc in range(-reach, reach + 1):
            pixels[np.clip(r + dr, 0, rows - 1), np.clip(c + dc, 0, columns - 1)] = colour


def read_pgm(out: Path) -> tuple[npt.NDArray[np.uint8], float, Array]:
    """Pixels (rows from the top), metres a cell and the lower left corner of a written map."""
    facts = dict(line.split(": ", 1) for line in (out / "map.yaml").read_text().splitlines() if ": " in line)
    head, _, body = (out / "map.pgm").read_bytes().partition(b"\n255\n")
    words = [word for line in head.split(b"\n") if not line.startswith(b"#") for word in line.split()]
    columns, rows = int(words[1]), int(words[2])
    origin = np.array([float(part) for part in facts["origin"].strip("[]").split(",")[:2]])
    return np.frombuffer(body, np.uint8).reshape(rows, columns), float(facts["resolution"]), origin
