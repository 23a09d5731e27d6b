"""The open real logs, and one of them as arrays that can be spoiled and written again as a CARMEN log."""

from __future__ import annotations

import gzip
import math
import os
import tempfile
from collections import Counter
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from daemon.replay.convert import convert
from estimator.numerics import se2
from tools.experiments.support.report import Skipped
from tools.sim.building.world import Array

VARIABLE: Final = "LUMILOOP_DATA"
LASER_LINES: Final = ("FLASER", "ROBOTLASER1")
UNRETURNED: Final = 0.98
"""Ranges above this share of the largest in a log are no returns."""


@dataclass(frozen=True, slots=True)
class Log:
    """A real log: its file below the folder of real logs, the lidar, and whether the robot has wheel odometry."""

    source: str
    lidar: str
    wheels: bool = True

    @property
    def urg(self) -> bool:
        """Whether the lidar is a URG-04LX, which sees four metres."""
        return self.lidar == "URG-04LX"


LOGS: Final = {
    "intel": Log("intel/intel.clf.gz", "SICK LMS"),
    "aces": Log("aces/aces.clf.gz", "SICK LMS"),
    "exp1": Log("urg04lx/exp1.dat.gz", "URG-04LX"),
    "exp2": Log("urg04lx/exp2.dat.gz", "URG-04LX"),
    "test_lab": Log("urg04lx/test_lab.clf.gz", "URG-04LX"),
    "freiburg-101": Log("keyscans/freiburg-101.clf.gz", "SICK LMS, key scans"),
    "fhw": Log("keyscans/fhw.clf.gz", "SICK LMS, key scans"),
    "wean2": Log("more/wean2.clf.gz", "SICK LMS"),
    "wean4": Log("more/wean4.clf.gz", "SICK LMS"),
    "dp-loop5": Log("more/dp-loop5.clf.gz", "SICK LMS"),
    "slambot-24JUL14_14m": Log("more/slambot-24JUL14_14m.clf.gz", "RPLIDAR A1"),
    "slambot-1AUG14_30m": Log("more/slambot-1AUG14_30m.clf.gz", "RPLIDAR A1"),
    "tb4-mac2": Log("more/tb4-mac2.clf.gz", "RPLIDAR A1"),
    "neato-ks-avoid": Log("more/neato-ks-avoid.clf.gz", "Neato LDS"),
    "neato-zn-square": Log("more/neato-zn-square.clf.gz", "Neato LDS"),
    "neato-olin18-avoid": Log("more/neato-olin18-avoid.clf.gz", "Neato LDS"),
    "yd-38": Log("more/yd-38.clf.gz", "YDLIDAR X4"),
    "ccny": Log("handheld/ccny.clf.gz", "URG-04LX", wheels=False),
    "utm": Log("utm30lx/scans.npz", "UTM-30LX", wheels=False),
    "funrobo-urg": Log("more/funrobo-urg.clf.gz", "URG-04LX", wheels=False),
    "leg-stat": Log("more/leg-stat.clf.gz", "URG-04LX", wheels=False),
    "windsor-a": Log("more/windsor-a.clf.gz", "RPLIDAR", wheels=False),
}


def folder() -> Path:
    """The folder of real logs.

    Raises:
        Skipped: there is none.
    """
    named = os.environ.get(VARIABLE)
    if not named or not Path(named).is_dir():
        raise Skipped(f"{VARIABLE} must name the folder of real logs (see docs/data.md)")
    return Path(named)


def present(wheels_only: bool = False) -> list[str]:
    """The names of those logs that are there; raises Skipped where none is."""
    root = folder()
    names = [name for name, log in LOGS.items() if (root / log.source).is_file() and (log.wheels or not wheels_only)]
    if not names:
        raise Skipped(f"{root} holds none of the logs of docs/data.md")
    return names


@cache
def _converted() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory()


def clf(name: str) -> Path:
    """A log as replay reads it, converted where it has to be."""
    source = folder() / LOGS[name].source
    if ".dat" not in source.name and source.suffix != ".npz":
        return source
    made = Path(_converted().name) / f"{name}.clf"
    if not made.exists():
        convert(source, made)
    return made


@dataclass(slots=True, eq=False)
class Drive:
    """A log as arrays.

    Attributes:
        setup: words of a laser line up to its ranges. other: all other lines.
        stamps: (n,) s. ranges: (n, beams) m. laser, robot: (n, 3) poses by odometry, m, m, rad.
        index: (n,) number of each scan in the log as it was. begun: number of the first scan that was spoiled.
    """

    setup: list[str]
    other: list[str]
    stamps: Array
    ranges: Array
    laser: Array
    robot: Array
    index: Array
    begun: int = 0

    @property
    def none(self) -> float:
        """Range that stands for no return, m."""
        return float(self.ranges.max()) if self.setup[0] == "FLASER" else 0.0

    @property
    def returned(self) -> Array:
        """(n, beams) true where a beam has a return."""
        largest = float(self.setup[5]) if self.setup[0] == "ROBOTLASER1" else float(self.ranges.max())
        return np.asarray((self.ranges > 0.0) & (self.ranges < UNRETURNED * largest))

    @property
    def bearings(self) -> Array:
        """(beams,) bearings as seen from the lidar, rad."""
        count = self.ranges.shape[1]
        if self.setup[0] == "ROBOTLASER1":
            return float(self.setup[2]) + float(self.setup[4]) * np.arange(count)
        return np.radians(-90.0 + (180.0 if count == 180 else 180.0 * count / (count - 1.0)) / count * np.arange(count))

    @property
    def way(self) -> Array:
        """(n,) path length by odometry up to each scan, m."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.robot[:, :2], axis=0).T))])

    def keep(self, which: Array) -> None:
        """Leave some of the scans, in the given order."""
        for name in ("stamps", "ranges", "laser", "robot", "index"):
            setattr(self, name, getattr(self, name)[which])

    def ride(self, steps: Array) -> None:
        """Let odometry measure other steps (n - 1, 3) between the scans, each in the frame of the one before."""
        mount = se2.between(self.robot[0], self.laser[0])
        pose = self.robot[0]
        for k, step in enumerate(steps):
            pose = se2.compose(pose, step)
            self.robot[k + 1], self.laser[k + 1] = pose, se2.compose(pose, mount)

    def steps(self) -> Array:
        """(n - 1, 3) steps of odometry between the scans."""
        return np.array([se2.between(a, b) for a, b in zip(self.robot[:-1], self.robot[1:], strict=True)])

    def write(self, path: Path) -> Path:
        """As a CARMEN log."""
        words, beams = " ".join(self.setup), " %.4f" * self.ranges.shape[1]
        remission, tail = (" 0", " 0 0 0 0 0") if self.setup[0] == "ROBOTLASER1" else ("", "")
        with path.open("w") as file:
            file.writelines(self.other)
            for t, ranges, laser, robot in zip(self.stamps, self.ranges, self.laser, self.robot, strict=True):
                poses = " %.9f" * 6 % (*laser, *robot)
                file.write(f"{words}{beams % tuple(ranges)}{remission}{poses}{tail} {t:.6f} a {t:.6f}\n")
        return path


def read(path: Path) -> Drive:
    """A CARMEN log as arrays; scans with another number of beams than most are left out."""
    with gzip.open(path, "rt") if path.suffix == ".gz" else path.open() as file:
        lines = [(line, line.split()) for line in file]
    other = [line for line, words in lines if words and words[0] not in LASER_LINES]
    scans = [words for _, words in lines if words and words[0] in LASER_LINES]
    at = 2 if scans[0][0] == "FLASER" else 9
    usual = Counter(int(words[at - 1]) for words in scans).most_common(1)[0][0]
    stamps, ranges, poses = [], [], []
    for words in scans:
        if int(words[at - 1]) != usual:
            continue
        after = at + usual + (0 if at == 2 else 1 + int(words[at + usual]))
        stamps.append(float(words[-3]))
        ranges.append(np.array(words[at : at + usual], float))
        poses.append(np.array(words[after : after + 6], float))
    pose = np.array(poses)
    whole = np.nan_to_num(np.array(ranges), nan=0.0, posinf=0.0)
    return Drive(scans[0][:at], other, np.array(stamps), whole, pose[:, :3], pose[:, 3:], np.arange(len(stamps)))


def wrapped(angle: Array) -> Array:
    """Angles within -pi to pi, rad."""
    return np.asarray((angle + math.pi) % math.tau - math.pi)
