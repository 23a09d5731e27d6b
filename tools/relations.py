"""The relations metric of SLAM benchmarks: how well pairs of poses agree with relations found by hand.

Kuemmerle, Steder, Dornhege, Ruhnke, Grisetti, Stachniss, Kleiner: "On measuring the accuracy of SLAM algorithms",
Autonomous Robots 27 (2009). A relation is the pose of the robot at one time as seen from the robot at another. The
metric does not depend on where a map has its origin, and never aligns anything. In the plane: the translational error
is the distance between the two displacements, the rotational error the angle between the two turns.

    python -m tools.relations TRAJECTORY.tum LOG.relations [--split S]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SAME_STAMP_S: Final = 1e-3
SPLIT_S: Final = 30.0
"""Relations between poses closer in time than this judge the front end; the others judge the map."""


@dataclass(frozen=True)
class Errors:
    """Errors of the relations whose two stamps the trajectory has: metres, degrees, time apart in s; and the others."""

    translation_m: Array
    rotation_deg: Array
    apart_s: Array
    missing: int

    def within(self, seconds: float) -> Errors:
        """Those between poses at most so far apart in time."""
        return self._only(self.apart_s <= seconds)

    def beyond(self, seconds: float) -> Errors:
        """Those between poses further apart in time."""
        return self._only(self.apart_s > seconds)

    def _only(self, chosen: npt.NDArray[np.bool_]) -> Errors:
        return Errors(self.translation_m[chosen], self.rotation_deg[chosen], self.apart_s[chosen], self.missing)

    def line(self, name: str) -> str:
        """Mean and sample standard deviation, as papers print them."""
        t, r = self.translation_m, self.rotation_deg
        if len(t) < 2:
            return f"{name:10s} n={len(t)}"
        moments = f"{t.mean():.4f} +- {t.std(ddof=1):.4f} m   {r.mean():.3f} +- {r.std(ddof=1):.3f} deg"
        return f"{name:10s} n={len(t):5d}   {moments}"


def read_tum(path: Path) -> tuple[Array, Array]:
    """Stamps (n,) and planar poses (n, 3) of a TUM trajectory."""
    rows = np.loadtxt(path, comments="#", ndmin=2)
    return rows[:, 0], np.column_stack([rows[:, 1], rows[:, 2], 2.0 * np.arctan2(rows[:, 6], rows[:, 7])])


def read_relations(path: Path) -> Array:
    """Rows of (stamp, later stamp, x, y, yaw)."""
    rows = np.loadtxt(path, comments="#", ndmin=2)
    return rows[:, [0, 1, 2, 3, 7]]


def evaluate(stamps: Array, poses: Array, relations: Array) -> Errors:
    """Errors of a trajectory, which must have a pose at every stamp that is to count."""
    order = np.argsort(stamps, kind="stable")
    stamps, poses = stamps[order], poses[order]
    first, found_first = _index(stamps, relations[:, 0])
    second, found_second = _index(stamps, relations[:, 1])
    found = found_first & found_second
    told, start, end = relations[found], poses[first[found]], poses[second[found]]
    cos, sin = np.cos(start[:, 2]), np.sin(start[:, 2])
    dx, dy = (end - start)[:, :2].T
    x, y = cos * dx + sin * dy - told[:, 2], cos * dy - sin * dx - told[:, 3]
    turn = end[:, 2] - start[:, 2] - told[:, 4]
    off = np.abs(np.remainder(turn + np.pi, 2.0 * np.pi) - np.pi)
    return Errors(np.hypot(x, y), np.degrees(off), np.abs(told[:, 1] - told[:, 0]), int(np.count_nonzero(~found)))


def _index(stamps: Array, wanted: Array) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Nearest stamp of each wanted one, and whether it is the same."""
    after = np.clip(np.searchsorted(stamps, wanted), 1, len(stamps) - 1)
    nearest = np.where(np.abs(stamps[after] - wanted) < np.abs(stamps[after - 1] - wanted), after, after - 1)
    return nearest, np.abs(stamps[nearest] - wanted) <= SAME_STAMP_S


def main() -> int:
    """Print the metric; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m tools.relations", description=__doc__.split("\n")[0])
    parser.add_argument("trajectory", type=Path)
    parser.add_argument("relations", type=Path)
    parser.add_argument("--split", type=float, default=SPLIT_S, help="seconds apart that part local from global")
    args = parser.parse_args()
    for path in (args.trajectory, args.relations):
        if not path.is_file():
            parser.error(f"{path}: no such file")
    try:
        errors = evaluate(*read_tum(args.trajectory), read_relations(args.relations))
    except (OSError, ValueError, IndexError) as error:
        parser.error(f"cannot compare {args.trajectory} with {args.relations}: {error}")
    print(errors.line("all"))
    print(errors.within(args.split).line("local"))
    print(errors.beyond(args.split).line("global"))
    print(f"missing    n={errors.missing:5d}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
