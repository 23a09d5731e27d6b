"""Scenes feed the fake lidar in the words of a sensor; a recorded log comes out bit for bit."""

from dataclasses import replace

import numpy as np

from hal.fake.lidar.models import MODELS
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry
from tools.sim.building.beams import IDEAL, Returns
from tools.sim.hybrid import HybridScene
from tools.sim.scene import Scenario, SimulatedScene, to_device


def test_words_of_a_sensor() -> None:
    """Rounded millimetres; nothing back and beyond DMAX become the model's own no-return word."""
    model = replace(MODELS["UST-10LX"], amax=3)
    echoes = np.array([[1.2344, 2.0, 0.0], [0.0, 0.0, 0.0], [30.5, 0.0, 0.0], [0.010, 0.0, 0.0]])
    scan = to_device(model, Returns(echoes, np.full((4, 3), 77, dtype=np.int32)))
    assert scan.ranges_mm.tolist() == [1234, 65533, 65533, 10]
    assert scan.intensity is not None
    assert scan.intensity.tolist() == [77, 0, 0, 77]
    assert scan.echoes_mm is not None
    assert scan.echoes_mm[:, 0].tolist() == [2000, 0, 0, 0]


def test_beam_times_and_bearings_match_what_the_sensor_states() -> None:
    """Ideal beams of a driving, turning robot land on the walls when the sensor's own geometry and times are used."""
    scene = SimulatedScene(Scenario("corridor_loop", "UTM-30LX", people=False, optics=IDEAL))
    scene.scan(100.0)
    t0 = 100.0 + 2.0 + 33.0  # in the first bend
    model = scene.model
    scan = scene.scan(t0)
    step = np.arange(model.steps)
    t = t0 + step * model.true_period_s / model.ares
    x, y, yaw = scene.truth(t).T
    assert abs(yaw[-1] - yaw[0]) > 0.003
    mount = scene.scenario.body.lidar
    angle = yaw + mount[2] + (step - model.afrt) * 2 * np.pi / model.ares
    reach = scan.ranges_mm / 1000.0
    hit_x = x + np.cos(yaw) * mount[0] - np.sin(yaw) * mount[1] + reach * np.cos(angle)
    hit_y = y + np.sin(yaw) * mount[0] + np.cos(yaw) * mount[1] + reach * np.sin(angle)
    valid = (scan.ranges_mm >= model.dmin) & (scan.ranges_mm <= model.dmax)
    off = scene.building.world.clearance(np.column_stack([hit_x, hit_y])[valid])
    assert valid.mean() > 0.9
    assert off.max() < 0.002


GEOMETRY = LidarGeometry("LMS", "", "", 360.0, 90.0, 0, 179, 10, 81000, 0.001, 0.2, 0.0)


def recorded(count: int = 5, geometry: LidarGeometry = GEOMETRY, beams: int = 180) -> list[RawScan | RawOdometry]:
    rng = np.random.default_rng(2)
    records: list[RawScan | RawOdometry] = []
    for k in range(count):
        ranges = rng.integers(100, 80000, beams).astype(np.int32)
        code = np.full(beams, VALID, dtype=np.int32)
        code[::7], ranges[::7] = 81830, 0
        t = 10.0 + 0.2 * k + 0.01 * (k % 2)
        records.append(RawOdometry(t, t, 0.1 * k, 0.0, 0.01 * k))
        records.append(RawScan(geometry, k, t, t, 0.0, -1, 0, 1, ranges, code))
    return records


def test_hybrid_scans_are_the_log_s_bit_for_bit() -> None:
    records = recorded()
    scene = HybridScene(records)
    scans = [record for record in records if isinstance(record, RawScan)]
    for start, raw in zip(scene.starts, scans, strict=True):
        made = scene.scan(float(start))
        assert made is not None
        np.testing.assert_array_equal(made.ranges_mm, np.where(raw.code == VALID, raw.ranges, raw.code))
    between = scene.scan(float(scene.starts[2]) + 0.1)
    assert between is not None
    np.testing.assert_array_equal(between.ranges_mm[1:7], scans[2].ranges[1:7])
    assert scene.scan(9.0) is None
    assert scene.scan(12.0) is None
