"""Pose graphs: time and chi2 from the file's start, against GTSAM in the same run where it is installed.

Then a dense graph of our own, and false loops: Bicocca as it comes (30 % of its loops are false), and M3500 with as
many random ones added. Needs ``LUMILOOP_DATA``; GTSAM is an optional peer (``pip install gtsam``). Times are processor
time of the thread that works, for ours and for the peer, which uses one thread here as well.
"""

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

from estimator.mapping.loop_closure import MOST, PHI, SETTLED
from estimator.mapping.pose_graph import Graph, optimise
from estimator.measurements import Array
from estimator.numerics import se2
from tools.ci.figures import Figure, bounded

COMMAND: Final = "LUMILOOP_DATA=... python -m tools.bench posegraph"
RUNS: Final = 5
BICOCCA: Final = 1842.39
"""Cost at our settings of the lowest solution found from any start scale, with no cap on iterations."""

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
    graph = dense()
    ms, found = _timed(lambda: optimise(graph))
    return [
        *figures,
        bounded("10 000 poses, 15 000 constraints: time", ms, "ms", "<= 1200", COMMAND),
        Figure("10 000 poses, 15 000 constraints: chi2", found.chi2, "", command=COMMAND),
        *_false_loops(Path(data) / "posegraphs"),
    ]


def dense(n: int = 10_000, loops: int = 5_000, seed: int = 0) -> Graph:
    """A walk of 1 m steps with right-angled turns on a small floor, with loops between poses that are near each other.

    Noise is that of M3500, 5 cm and 0.6 deg; the start is the walk's own odometry, each region of it brought to its
    place once, as a graph is that was solved before the last loops came.
    """
    rng, side = np.random.default_rng(seed), 40
    sigma = np.array((0.05, 0.05, 0.01))
    truth = np.zeros((n, 3))
    for k in range(1, n):
        x, y, yaw = truth[k - 1]
        quarter = round(yaw / (np.pi / 2)) % 4
        ahead = (x + (1, 0, -1, 0)[quarter], y + (0, 1, 0, -1)[quarter])
        turn = rng.choice((-1, 0, 0, 0, 0, 1))
        if not (0 < ahead[0] < side and 0 < ahead[1] < side):
            turn = rng.choice((-1, 1))
        truth[k] = (min(max(ahead[0], 0), side), min(max(ahead[1], 0), side), (quarter + turn) * np.pi / 2)
    cell: dict[tuple[int, int], list[int]] = {}
    for k, (x, y, _) in enumerate(truth):
        cell.setdefault((round(x), round(y)), []).append(k)
    pairs = [(k, k + 1) for k in range(n - 1)]
    while len(pairs) < n - 1 + loops:
        k = int(rng.integers(n))
        other = int(rng.choice(cell[round(truth[k, 0]), round(truth[k, 1])]))
        if abs(k - other) > 1:
            pairs.append((other, k))
    true = np.array([se2.between(truth[i], truth[j]) for i, j in pairs])
    between = true + sigma * rng.standard_normal(true.shape)
    information = np.tile((sigma[0] ** -2, 0.0, 0.0, sigma[1] ** -2, 0.0, sigma[2] ** -2), (len(pairs), 1))
    poses = truth + np.array((0.5, 0.5, 0.1)) * rng.standard_normal(truth.shape)
    poses[0] = truth[0]
    return Graph(poses, np.array(pairs, np.int64), between, information, np.zeros(len(pairs), np.bool_))


def _false_loops(folder: Path) -> list[Figure]:
    """At the settings that the map is made with; every constraint but the way is doubted."""
    bicocca = doubting(read_g2o(folder / "bicocca_30pct_false_loops.g2o.gz"))
    ms, found = _timed(lambda: optimise(bicocca, MOST, SETTLED, PHI), 2)
    trust = found.trust[bicocca.doubtful]
    truth = optimise(read_g2o(folder / "m3500.g2o.gz"))
    clean = doubting(read_g2o(folder / "m3500.g2o.gz"))
    spoiled = with_false_loops(clean, 0.3, 0)
    after = optimise(spoiled, MOST, SETTLED, PHI)
    false = after.trust[len(clean.edges) :]
    true = after.trust[: len(clean.edges)][clean.doubtful]
    apart = np.hypot(*(after.poses - truth.poses)[:, :2].T)
    return [
        Figure("bicocca, 30 % false: time", ms, "ms", command=COMMAND),
        Figure("bicocca: loops, believed", float((trust > 0.25).sum()), f"of {len(trust)}", command=COMMAND),
        Figure("bicocca: loops, voted out", float((trust < 0.05).sum()), f"of {len(trust)}", command=COMMAND),
        bounded("bicocca: cost over the lowest known", found.chi2 / BICOCCA, "", "<= 1.001", COMMAND),
        Figure("m3500, 30 % false: believed of the false", 100.0 * float((false > 0.1).mean()), "%", command=COMMAND),
        Figure("m3500, 30 % false: lost of the true", 100.0 * float((true < 0.25).mean()), "%", command=COMMAND),
        Figure("m3500, 30 % false: moved, median", float(np.median(apart)), "m", command=COMMAND),
    ]


def doubting(graph: Graph) -> Graph:
    """The same, every constraint but those from a pose to the next doubted."""
    graph.doubtful = graph.edges[:, 1] - graph.edges[:, 0] != 1
    return graph


def with_false_loops(graph: Graph, share: float, seed: int) -> Graph:
    """The same with loops between random poses, said to be near each other, as ``share`` of all loops."""
    rng, n = np.random.default_rng(seed), len(graph.poses)
    count = round(share / (1.0 - share) * int(graph.doubtful.sum()))
    a = rng.integers(0, n, count)
    pairs = np.column_stack((a, (a + rng.integers(2, n - 2, count)) % n))
    between: Array = rng.normal(0.0, (0.3, 0.3, 0.05), (count, 3))
    return Graph(
        graph.poses,
        np.vstack((graph.edges, pairs)),
        np.vstack((graph.between, between)),
        np.vstack((graph.information, np.repeat(graph.information[graph.doubtful][:1], count, axis=0))),
        np.concatenate((graph.doubtful, np.ones(count, np.bool_))),
    )


def _timed(work: Callable[[], T], runs: int = RUNS) -> tuple[float, T]:
    times = []
    for _ in range(runs):
        begin = time.thread_time()
        result = work()
        times.append(time.thread_time() - begin)
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
