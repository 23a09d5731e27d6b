"""Pose graphs: time and chi2 from the file's start, against GTSAM in the same run where it is installed.

Needs ``LUMILOOP_DATA``; GTSAM is an optional peer (``pip install gtsam``).
"""

from __future__ import annotations

import gzip
import os
import tempfile
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
import numpy.typing as npt

from estimator.posegraph import Graph, optimise
from tools.figures import Figure, bounded

COMMAND: Final = "LUMILOOP_DATA=... python -m tools.bench posegraph"
RUNS: Final = 5

T = TypeVar("T")


def read_g2o(path: Path) -> Graph:
    """A graph of VERTEX_SE2 and EDGE_SE2 lines, gzipped or not; poses in order of their numbers, none doubted.

    Raises:
        ValueError: a line that is neither, or that names an unknown vertex, by its number.
    """
    text = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    vertices: dict[int, list[float]] = {}
    edges: list[tuple[int, int]] = []
    rows: list[list[float]] = []
    for number, line in enumerate(text.splitlines(), 1):
        words = line.split()
        if words[:1] == ["VERTEX_SE2"] and len(words) == 5:
            vertices[int(words[1])] = [float(word) for word in words[2:]]
        elif words[:1] == ["EDGE_SE2"] and len(words) == 12:
            edges.append((int(words[1]), int(words[2])))
            rows.append([float(word) for word in words[3:]])
        elif words and words[0] != "FIX":
            raise ValueError(f"{path}, line {number}: expected VERTEX_SE2 or EDGE_SE2, got {line[:40]!r}")
    place = {vertex: k for k, vertex in enumerate(sorted(vertices))}
    try:
        pairs = np.array([(place[i], place[j]) for i, j in edges], np.int64).reshape(-1, 2)
    except KeyError as error:
        raise ValueError(f"{path}: an edge names vertex {error}, which does not exist") from error
    values = np.array(rows).reshape(-1, 9)
    poses = np.array([vertices[vertex] for vertex in sorted(vertices)]).reshape(-1, 3)
    doubtful: npt.NDArray[np.bool_] = np.zeros(len(pairs), bool)
    return Graph(poses, pairs, values[:, :3].copy(), values[:, 3:].copy(), doubtful)


def run() -> list[Figure]:
    """Both graphs.

    Raises:
        RuntimeError: LUMILOOP_DATA does not name the folder of real logs.
    """
    data = os.environ.get("LUMILOOP_DATA")
    if not data:
        raise RuntimeError("LUMILOOP_DATA does not name the folder of real logs (see docs/data.md)")
    figures = []
    for name, target in (("m3500", "<= 70"), ("city10000", "<= 400")):
        path = Path(data) / "posegraphs" / f"{name}.g2o.gz"
        graph = read_g2o(path)
        ms, found = _timed(lambda graph=graph: optimise(graph))
        figures += [
            bounded(f"{name}: time", ms, "ms", target, COMMAND),
            Figure(f"{name}: chi2", found.chi2, "", command=COMMAND),
            Figure(f"{name}: iterations", found.iterations, "", command=COMMAND),
        ]
        figures += _peer(name, path, ms, found.chi2)
    return figures


def _timed(work: Callable[[], T]) -> tuple[float, T]:
    times = []
    for _ in range(RUNS):
        begin = time.perf_counter()
        result = work()
        times.append(time.perf_counter() - begin)
    return 1e3 * min(times), result


def _peer(name: str, path: Path, ms: float, chi2: float) -> list[Figure]:
    """GTSAM's Gauss-Newton and Levenberg-Marquardt, the faster of the two."""
    try:
        gtsam = import_module("gtsam")
    except ImportError as error:
        print(f"gtsam: not compared, {error}")
        return []
    with tempfile.TemporaryDirectory() as folder:
        plain = Path(folder) / "graph.g2o"
        plain.write_bytes(gzip.decompress(path.read_bytes()))
        factors, start = gtsam.readG2o(str(plain), False)
    sigmas = gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))
    factors.add(gtsam.PriorFactorPose2(0, start.atPose2(0), sigmas))
    makers = [
        lambda: gtsam.GaussNewtonOptimizer(factors, start, gtsam.GaussNewtonParams()),
        lambda: gtsam.LevenbergMarquardtOptimizer(factors, start, gtsam.LevenbergMarquardtParams()),
    ]
    outcomes = [_timed(lambda make=make: make().optimize()) for make in makers]
    theirs, result = min(outcomes, key=lambda outcome: outcome[0])
    their_chi2 = 2.0 * factors.error(result)
    version = getattr(gtsam, "__version__", "")
    return [
        Figure(f"{name}: gtsam {version}", theirs, "ms", command=COMMAND),
        bounded(f"{name}: ours / gtsam's time", ms / theirs, "", "<= 0.8", COMMAND),
        bounded(f"{name}: our chi2 / gtsam's", chi2 / their_chi2, "", "<= 1.001", COMMAND),
    ]
