"""The scan sources of the fake lidar: the room, and recorded ranges."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hal.errors import DataInvalid, DeviceMissing
from hal.fake.lidar.models import MODELS, URG_04LX, UTM_30LX, LidarModel
from hal.fake.lidar.scan_world import NO_OBJECT, RecordedRanges, Room


def test_room_is_seen_as_it_is() -> None:
    """The back wall and the right-hand wall, as the sensor sees them from where it is."""
    room = Room(UTM_30LX, noise_mm=0.0)
    scan = room(0.0)
    x, y, heading = room.pose(np.array([540 / 1440 * UTM_30LX.true_period_s]))[0]
    assert heading == pytest.approx(np.pi / 2, abs=0.01)  # looking along +y
    ahead, right = scan.ranges_mm[540], scan.ranges_mm[540 - 360]
    assert ahead == pytest.approx(1e3 * (5.0 - y), abs=5)
    assert right == pytest.approx(1e3 * (7.0 - x), abs=5)
    assert room(15.0).ranges_mm[540] != ahead
    assert scan.ranges_mm.min() > 300
    assert np.array_equal(Room(UTM_30LX, seed=3)(1.0).ranges_mm, Room(UTM_30LX, seed=3)(1.0).ranges_mm)


@pytest.mark.parametrize("model", MODELS.values(), ids=MODELS)
def test_room_fits_every_model(model: LidarModel) -> None:
    scan = Room(model)(0.0)
    assert scan.ranges_mm.shape == (model.steps,)
    seen = scan.ranges_mm != NO_OBJECT
    assert seen.mean() > 0.5
    assert scan.ranges_mm[seen].min() >= model.dmin
    assert scan.ranges_mm[seen].max() <= model.dmax


def test_recorded_ranges(tmp_path: Path) -> None:
    path = tmp_path / "log.npz"
    rows = np.arange(3 * 682, dtype=np.float64).reshape(3, 682)
    rows[0, 0] = np.nan
    np.savez(path, range_mm=rows)
    source = RecordedRanges(path, URG_04LX)
    scans = [source(float(k)) for k in range(4)]
    assert scans[3] is None
    assert scans[0] is not None
    assert scans[1] is not None
    assert scans[0].ranges_mm[:46].tolist() == [0] * 45 + [1]
    assert scans[1].ranges_mm[44:].tolist() == rows[1].tolist()


def test_recorded_ranges_that_do_not_fit(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissing, match="no such file"):
        RecordedRanges(tmp_path / "nothing.npz", UTM_30LX)
    path = tmp_path / "log.npz"
    np.savez(path, range_mm=np.zeros((3, 682)))
    with pytest.raises(DataInvalid, match=r"is 3x682, UTM-30LX.* has 1081 steps \(choose the --model"):
        RecordedRanges(path, UTM_30LX)
    np.savez(path, ranges=np.zeros((3, 682)))
    with pytest.raises(DataInvalid, match="no array `range_mm`"):
        RecordedRanges(path, URG_04LX)
    path.write_bytes(b"PK\x03\x04 broken")
    with pytest.raises(DataInvalid, match=r"log\.npz"):
        RecordedRanges(path, URG_04LX)
