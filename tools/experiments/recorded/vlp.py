"""Public recordings of received light, read from the folder named by LUMILOOP_DATA, in SI units and REP-103 frames.

Origin: the static campaigns are of github.com/ShawnSun95/VLPCalibration, the walks of ShawnSun95/OB_GINS_VLP, the raw
photodiode stream of ShawnSun95/VLPtoolbox (Wuhan University). None of it is part of this project. The files say less
than one must know; what was found by fitting, and is checked by tests, is mended here:

* second campaign: strengths (and spreads) of lamps 2 and 3 are exchanged;
* walks: places are (north, east, up) while the published lamp coordinates are (east, north, up). Everything is
  returned as (east, north, up), which is right-handed, so that yaw is counter-clockwise seen from above;
* walks: "delta angles" are degrees; the IMU's axes point backward, left and down on the robot (centripetal
  acceleration and gravity tell). They are returned forward, left, up;
* walks: the truth file repeats strengths that are computed from a model; they are not read.
"""

import gzip
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from tools.experiments.support.report import Skipped

Array = npt.NDArray[np.float64]

STATIC_LAMPS: Final = ((0.26, 0.66, 2.6), (4.61, 0.67, 2.6), (4.57, 4.25, 2.6), (0.18, 4.25, 2.6), (2.45, 2.49, 2.6))
WALK_LAMPS: Final = (
    (0.351, 1.342, 2.832),
    (3.56, 1.15, 2.841),
    (1.711, 3.305, 2.840),
    (3.5, 6.249, 2.833),
    (0.352, 5.972, 2.839),
)
WALK_ORDERS: Final = (0.7, 0.9, 0.9, 1.0, 1.0)
WALKS: Final = ("circle_level", "circle_inclined10", "square_blocked")
CAMPAIGNS: Final = ("RSS", "RSS_0923")
TONES_HZ: Final = (735.0, 215.0, 640.0, 305.0, 865.0, 520.0)
RAW_RATE: Final = 2000.0


@dataclass(frozen=True, slots=True, eq=False)
class Campaign:
    """Strengths at surveyed places.

    Attributes:
        lamps: (K, 3) m. places: (n, 3) m. rss, spread: (n, K) in the recorders' unit; spread None where not recorded.
    """

    name: str
    lamps: Array
    places: Array
    rss: Array
    spread: Array | None


@dataclass(frozen=True, slots=True, eq=False)
class Inertial:
    """IMU of a walk in base_link (x forward, y left, z up), one row per 5 ms.

    Attributes:
        t: end of each interval, s (Unix time). velocity: (n, 3) specific force times interval, m/s.
        angle: (n, 3) rad turned about each axis.
    """

    t: Array
    velocity: Array
    angle: Array

    def yaw(self, t: Array) -> Array:
        """Yaw turned since the recording began, at times ``t``, rad; the gyro's bias is still in it."""
        return np.interp(t, self.t, np.cumsum(self.angle[:, 2]))

    def lean(self, t: Array, window: float = 1.0) -> Array:
        """(n, 2) slopes of the receiver's axis (`survey.Receiver`) by mean specific force around ``t``.

        At rest they are true; while moving they contain the robot's own acceleration over 9.81 m/s2.
        """
        total = np.vstack((np.zeros(3), np.cumsum(self.velocity, axis=0)))
        low = np.searchsorted(self.t, t - 0.5 * window)
        high = np.maximum(np.searchsorted(self.t, t + 0.5 * window), low + 1)
        high = np.minimum(high, len(self.t))
        low = np.minimum(low, high - 1)
        force = total[high] - total[low]
        slopes: Array = -force[:, :2] / force[:, 2:]
        return slopes


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """One minute under five lamps.

    Attributes:
        lamps: (5, 3) m. orders: Lambert orders that the recorders used. t: (n,) Unix time, 1 Hz.
        rss: (n, 5) strengths, recorders' unit; they lag behind the truth by up to 0.5 s. recorders_fix: (n, 3) m.
        truth: (n, 3) m, of the receiver. imu: see :class:`Inertial`.
    """

    name: str
    lamps: Array
    orders: Array
    t: Array
    rss: Array
    recorders_fix: Array
    truth: Array
    imu: Inertial


@dataclass(frozen=True, slots=True, eq=False)
class Raw:
    """An uninterrupted stream of converter words with six lamps as sinusoids; ``tones`` in the order of the lamps."""

    words: Array
    rate: float
    tones: tuple[float, ...]


def folder() -> Path:
    """The ``vlp`` folder.

    Raises:
        Skipped: LUMILOOP_DATA is not set, or has no such folder.
    """
    root = os.environ.get("LUMILOOP_DATA")
    if not root:
        raise Skipped("LUMILOOP_DATA is not set: it names the folder of recorded data (see docs/data.md)")
    path = Path(root) / "vlp"
    if not path.is_dir():
        raise Skipped(f"{path} is not a folder: LUMILOOP_DATA must name the folder that holds vlp/ (see docs/data.md)")
    return path


def _columns(path: Path, least: int) -> Array:
    """Numbers of a text file, one row per line; lines may differ in what follows the first ``least`` columns.

    Raises:
        Skipped: there is no such file. ValueError: it is not such a table; says file and line.
    """
    if not path.is_file():
        raise Skipped(f"{path} is missing")
    content = gzip.decompress(path.read_bytes()).decode() if path.suffix == ".gz" else path.read_text()
    rows = []
    for number, line in enumerate(content.splitlines(), 1):
        words = line.split()
        if not words:
            continue
        if len(words) < least:
            raise ValueError(f"{path}, line {number}: {len(words)} columns, at least {least} expected")
        try:
            rows.append([float(word) for word in words[:least]])
        except ValueError as error:
            raise ValueError(f"{path}, line {number}: {error}") from None
    table = np.array(rows)
    if not len(rows) or not np.isfinite(table).all():
        raise ValueError(f"{path}: {'no data' if not rows else 'a value is not finite'}")
    return table


def campaign(name: str) -> Campaign:
    """A static campaign, ``RSS`` (73 places) or ``RSS_0923`` (81 places)."""
    if name not in CAMPAIGNS:
        raise ValueError(f"no campaign is called {name!r}; there are {', '.join(CAMPAIGNS)}")
    later = name == "RSS_0923"
    table = _columns(folder() / "static" / f"{name}.txt", 13 if later else 8)
    order = [0, 2, 1, 3, 4] if later else [0, 1, 2, 3, 4]
    spread = table[:, 8:13][:, order] if later else None
    return Campaign(name, np.array(STATIC_LAMPS), table[:, :3], table[:, 3:8][:, order], spread)


def walk(name: str) -> Walk:
    """A walk, one of `WALKS`."""
    if name not in WALKS:
        raise ValueError(f"no walk is called {name!r}; there are {', '.join(WALKS)}")
    source = folder() / "walks"
    seen = _columns(source / f"{name}_rss.txt", 9)
    truth = _columns(source / f"{name}_truth.txt", 4)
    if len(seen) != len(truth) or np.any(seen[:, 0] != truth[:, 0]):
        raise ValueError(f"{source}/{name}: strengths and truth are not of the same instants")
    imu = _columns(source / f"{name}_imu.txt.gz", 7)
    axes = np.array([-1.0, 1.0, -1.0])  # backward, left, down -> forward, left, up
    inertial = Inertial(imu[:, 0], imu[:, 1:4] * axes, np.radians(imu[:, 4:7]) * axes)
    enu = [2, 1, 3]
    lamps, orders = np.array(WALK_LAMPS), np.array(WALK_ORDERS)
    return Walk(name, lamps, orders, seen[:, 0], seen[:, 4:9], seen[:, enu], truth[:, enu], inertial)


def raw() -> Raw:
    """The photodiode's stream; its first and last value are cut off in the file and are left out."""
    path = folder() / "raw" / "photodiode_2khz.txt.gz"
    if not path.is_file():
        raise Skipped(f"{path} is missing")
    with gzip.open(path, "rt") as file:
        words = file.read().replace("\n", ",").split(",")
    try:
        values = np.array([float(word) for word in words if word.strip()])
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    return Raw(values[1:-1], RAW_RATE, TONES_HZ)
