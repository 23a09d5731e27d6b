"""Two scan sources for the fake lidar: a small room with a moving sensor, and recorded ranges.

They serve to try a daemon without a sensor. They do not model glass, mixed pixels or people.
"""

from __future__ import annotations

import math
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from hal.errors import DataInvalid, DeviceMissing
from hal.fake.lidar.models import LidarModel
from hal.fake.lidar.scan import FakeScan

NO_OBJECT = 1
"""Error code of a beam without a return (UTM: no object in range; URG: too little light)."""

ROOM = ((0.0, 0.0), (7.0, 0.0), (7.0, 3.5), (6.2, 3.5), (6.2, 5.0), (1.0, 5.0), (1.0, 4.2), (0.0, 4.2))
COLUMN = ((3.4, 3.3), (3.7, 3.3), (3.7, 3.6), (3.4, 3.6))
"""Corners in metres, in order; the room's outline has no symmetry, so that a pose in it is unique."""

CENTRE, HALF_AXES = (3.3, 1.9), (1.6, 0.7)
LAP_S = 60.0
"""Time of one round on the ellipse, heading along it: at most 0.17 m/s and 0.25 rad/s."""


def _walls() -> npt.NDArray[np.float64]:
    rows = []
    for outline in (ROOM, COLUMN):
        rows += [(*a, *b) for a, b in zip(outline, outline[1:] + outline[:1], strict=True)]
    return np.array(rows)


class Room:
    """A `ScanSource`: a room of 7 x 5 m with a column, scanned from an ellipse around its middle.

    Args:
        model: the sensor.
        noise_mm: one sigma of the range noise.
        seed: of the noise.
        lap_s: time of a round; infinite: the sensor stands still.
    """

    def __init__(self, model: LidarModel, noise_mm: float = 8.0, seed: int = 0, lap_s: float = LAP_S) -> None:
        self._model = model
        self._lap_s = lap_s
        self._noise = noise_mm
        self._chance = np.random.default_rng(seed)
        self._walls = _walls()
        steps = np.arange(model.steps)
        self._bearings = (steps - model.afrt) * (2.0 * math.pi / model.ares)
        self._beam_t = steps * (model.true_period_s / model.ares)

    def pose(self, t_mono: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """True x, y (m) and heading (rad) of the sensor at the given times, shape (n, 3)."""
        phase = t_mono * (2.0 * math.pi / self._lap_s)
        x = CENTRE[0] + HALF_AXES[0] * np.cos(phase)
        y = CENTRE[1] + HALF_AXES[1] * np.sin(phase)
        heading = np.arctan2(HALF_AXES[1] * np.cos(phase), -HALF_AXES[0] * np.sin(phase))
        return np.column_stack((x, y, heading))

    def __call__(self, t_mono: float) -> FakeScan:
        """The revolution that passes step 0 at ``t_mono``; every beam is cast from the pose at its own time."""
        pose = self.pose(np.asarray(t_mono + self._beam_t, dtype=np.float64))
        ranges = 1e3 * self._cast(pose[:, :2], pose[:, 2] + self._bearings)
        ranges = np.rint(ranges + self._chance.normal(0.0, self._noise, ranges.size))
        seen = (ranges >= self._model.dmin) & (ranges <= self._model.dmax)
        intensity = np.where(seen, 4.0e6 / np.maximum(ranges, 500.0), 0.0)
        return FakeScan(np.where(seen, ranges, NO_OBJECT).astype(np.int32), intensity.astype(np.int32))

    def _cast(self, origin: npt.NDArray[np.float64], angle: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """Distance in metres to the nearest wall along each ray: ray and segment as two linear equations."""
        dx, dy = np.cos(angle)[:, None], np.sin(angle)[:, None]
        ax, ay, bx, by = self._walls.T
        ex, ey = bx - ax, by - ay
        ox, oy = ax - origin[:, :1], ay - origin[:, 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = dx * ey - dy * ex
            along = (ox * ey - oy * ex) / cross
            on_wall = (ox * dy - oy * dx) / cross
        hit = (cross != 0.0) & (along > 0.0) & (on_wall >= 0.0) & (on_wall <= 1.0)
        return np.asarray(np.where(hit, along, np.inf).min(axis=1))


class RecordedRanges:
    """A :data:`hal.fake.lidar.scan.ScanSource`: one recorded scan for each revolution, then None.

    Args:
        path: ``.npz`` file with an array ``range_mm`` of shape (scans, steps), steps from AMIN (or 0) to AMAX, and
            optionally ``intensity`` of the same shape.
        model: the sensor that reports them.

    Raises:
        DeviceMissing: no such file.
        DataInvalid: not an ``.npz`` file of ranges, or a width other than the sensor's.
    """

    def __init__(self, path: Path, model: LidarModel) -> None:
        self._next = 0
        try:
            with path.open("rb") as file, np.load(file, allow_pickle=False) as data:
                arrays = {name: data[name] for name in ("range_mm", "intensity") if name in data}
        except FileNotFoundError as error:
            raise DeviceMissing(str(path), "no such file", "expected an .npz file of ranges") from error
        except (ValueError, OSError, EOFError, BadZipFile) as error:
            raise DataInvalid(str(path), f"not an .npz file: {error}") from error
        if "range_mm" not in arrays:
            raise DataInvalid(str(path), "holds no array `range_mm`", "millimetres, one row a scan")
        self._arrays = {name: _padded(path, name, rows, model) for name, rows in arrays.items()}

    def __call__(self, t_mono: float) -> FakeScan | None:
        """The next recorded scan."""
        rows = self._arrays["range_mm"]
        if self._next == len(rows):
            return None
        row, self._next = self._next, self._next + 1
        intensity = self._arrays.get("intensity")
        return FakeScan(rows[row], None if intensity is None else intensity[row])


def _padded(path: Path, name: str, rows: npt.NDArray[np.generic], model: LidarModel) -> npt.NDArray[np.int32]:
    widths = (model.steps, model.steps - model.amin)
    if rows.ndim != 2 or rows.shape[1] not in widths:
        shape = "x".join(map(str, rows.shape))
        problem = f"`{name}` is {shape}, {model.modl} has {widths[1]} steps"
        raise DataInvalid(str(path), problem, "choose the --model that recorded it")
    values = np.nan_to_num(rows.astype(np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    return np.pad(np.rint(values).astype(np.int32), ((0, 0), (model.steps - rows.shape[1], 0)))
