"""The open real logs, and one of them as arrays that can be spoiled and written again as a CARMEN log."""

import gzip
import os
import tempfile
from collections import Counter
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from daemon.replay.convert import convert
from estimator.numerics import se2
from tools.experiments.support.report import Skipped
from tools.sim.building.world import Array

Index = npt.NDArray[np.int_]

VARIABLE: Final = "LUMILOOP_DATA"
UNRETURNED: Final = 0.98
"""Ranges above this share of the largest that the log names are no returns."""
SICK, URG, RPLIDAR, NEATO = "SICK LMS", "URG-04LX", "RPLIDAR A1", "Neato LDS"


@dataclass(frozen=True, slots=True)
class Log:
    """A real log: its file below the folder of real logs, the lidar, and whether the robot has wheel odometry."""

    source: str
    lidar: str
    wheels: bool = True


LOGS: Final = {
    "intel": Log("intel/intel.clf.gz", SICK),
    "aces": Log("aces/aces.clf.gz", SICK),
    "exp1": Log("urg04lx/exp1.dat.gz", URG),
    "exp2": Log("urg04lx/exp2.dat.gz", URG),
    "test_lab": Log("urg04lx/test_lab.clf.gz", URG),
    "freiburg-101": Log("keyscans/freiburg-101.clf.gz", SICK),
    "fhw": Log("keyscans/fhw.clf.gz", SICK),
    "wean2": Log("more/wean2.clf.gz", SICK),
    "wean4": Log("more/wean4.clf.gz", SICK),
    "dp-loop5": Log("more/dp-loop5.clf.gz", SICK),
    "slambot-24JUL14_14m": Log("more/slambot-24JUL14_14m.clf.gz", RPLIDAR),
    "slambot-1AUG14_30m": Log("more/slambot-1AUG14_30m.clf.gz", RPLIDAR),
    "tb4-mac2": Log("more/tb4-mac2.clf.gz", RPLIDAR),
    "neato-ks-avoid": Log("more/neato-ks-avoid.clf.gz", NEATO),
    "neato-zn-square": Log("more/neato-zn-square.clf.gz", NEATO),
    "neato-olin18-avoid": Log("more/neato-olin18-avoid.clf.gz", NEATO),
    "yd-38": Log("more/yd-38.clf.gz", "YDLIDAR X4"),
    "ccny": Log("handheld/ccny.clf.gz", URG, wheels=False),
    "utm": Log("utm30lx/scans.npz", "UTM-30LX", wheels=False),
    "funrobo-urg": Log("more/funrobo-urg.clf.gz", URG, wheels=False),
    "leg-stat": Log("more/leg-stat.clf.gz", URG, wheels=False),
    "windsor-a": Log("more/windsor-a.clf.gz", RPLIDAR, wheels=False),
}


def folder() -> Path:
    """The folder of real logs; raises Skipped where there is none."""
    named = os.environ.get(VARIABLE)
    if not named or not Path(named).is_dir():
        raise Skipped(f"{VARIABLE} must name the folder of real logs (see docs/data.md)")
    return Path(named)


def present(of: tuple[str, ...] = ()) -> list[str]:
    """The names of those logs that are there, of all or of some; raises Skipped where none is."""
    names = [name for name in of or LOGS if (folder() / LOGS[name].source).is_file()]
    if not names:
        raise Skipped(f"{folder()} holds none of {', '.join(of or LOGS)}")
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


@dataclass(eq=False)
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
    index: Index
    begun: int = 0

    @cached_property
    def none(self) -> float:
        """Range that stands for no return, m."""
        return float(self.ranges.max()) if self.setup[0] == "FLASER" else 0.0

    @property
    def returned(self) -> Array:
        """(n, beams) true where a beam has a return."""
        largest = self.none or float(self.setup[5])
        return np.asarray((self.ranges > 0.0) & (self.ranges < UNRETURNED * largest))

    @cached_property
    def bearings(self) -> Array:
        """(beams,) bearings as seen from the lidar, rad."""
        start, step = (-0.5 * np.pi, np.pi / 180.0) if self.none else (float(self.setup[2]), float(self.setup[4]))
        return np.asarray(start + step * np.arange(self.ranges.shape[1]))

    @property
    def way(self) -> Array:
        """(n,) path length by odometry up to each scan, m."""
        return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(self.robot[:, :2], axis=0).T))])

    def keep(self, which: Index) -> None:
        """Leave some of the scans, in the given order."""
        for name in ("stamps", "ranges", "laser", "robot", "index"):
            setattr(self, name, getattr(self, name)[which])

    def steps(self) -> Array:
        """(n - 1, 3) steps of odometry between the scans, each in the frame of the scan before."""
        return np.array([se2.between(a, b) for a, b in zip(self.robot[:-1], self.robot[1:], strict=True)])

    def ride(self, steps: Array, since: int = 0) -> None:
        """Let odometry measure these steps (k, 3) from a scan on."""
        mount = se2.between(self.robot[0], self.laser[0])
        for k, step in enumerate(steps, since):
            self.robot[k + 1] = se2.compose(self.robot[k], step)
        self.laser[since:] = [se2.compose(pose, mount) for pose in self.robot[since:]]

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
    scans = [words for _, words in lines if words and words[0] in ("FLASER", "ROBOTLASER1")]
    other = [line for line, words in lines if words and words[0] not in ("FLASER", "ROBOTLASER1")]
    at = 2 if scans[0][0] == "FLASER" else 9
    usual = Counter(words[at - 1] for words in scans).most_common(1)[0][0]
    scans = [words for words in scans if words[at - 1] == usual]
    end = at + int(usual)
    poses = [end + (0 if at == 2 else 1 + int(words[end])) for words in scans]
    ranges = np.nan_to_num(np.array([words[at:end] for words in scans], float), nan=0.0, posinf=0.0)
    pose = np.array([words[k : k + 6] for k, words in zip(poses, scans, strict=True)], float)
    stamps = np.array([words[-3] for words in scans], float)
    return Drive(scans[0][:at], other, stamps, ranges, pose[:, :3], pose[:, 3:], np.arange(len(scans)))
