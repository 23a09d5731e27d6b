"""Scenes feed the fake lidar in the sensor's own words, and a recorded log comes out of it bit for bit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hal.fake.lidar.models import MODELS
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry
from tools.sim.building.beams import IDEAL, Returns
from tools.sim.hybrid import HybridScene, Trajectory
from tools.sim.scene import PAPER, Scenario, SimulatedScene, no_return, to_device


def test_papers_robot() -> None:
    scene = SimulatedScene(PAPER)
    steps = scene.model.amax - scene.model.amin
    assert (steps + 1, steps * 360.0 / scene.model.ares, scene.model.rpm) == (721, 180.0, 2400)
    assert scene.scan(5.0).ranges_mm.shape == (721,)
    assert scene.drive.length_m == pytest.approx(160.0, abs=2.0)


@pytest.mark.parametrize("name", sorted(MODELS))
def test_every_model_gets_one_element_per_step(name: str) -> None:
    scene = SimulatedScene(Scenario(lidar=name))
    scan = scene.scan(1.0)
    assert scan.ranges_mm.dtype == np.int32
    assert scan.ranges_mm.shape == (scene.model.steps,)
    assert scan.echoes_mm is not None
    assert scan.echoes_mm.shape == (scene.model.steps, 2)
    seen = scan.ranges_mm[scene.model.amin :]
    valid = (seen >= scene.model.dmin) & (seen <= scene.model.dmax)
    assert 0.2 < valid.mean() <= 1.0
    assert set(np.unique(seen[~valid])) <= {no_return(scene.model)}


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


def test_robot_waits_for_the_first_scan() -> None:
    scene = SimulatedScene(PAPER)
    start = scene.truth(np.array([0.0, 500.0]))
    np.testing.assert_array_equal(start[0], start[1])
    before = scene.odometry_after(3.0)
    assert before is not None
    np.testing.assert_array_equal(before[1], 0.0)
    scene.scan(700.0)
    later = scene.truth(np.array([700.0, 700.0 + PAPER.dwell_s, 710.0]))
    np.testing.assert_allclose(later[:2], start, atol=1e-12)
    assert later[2, 0] - start[0, 0] > 1.0


def test_a_held_robot_drives_when_it_is_released() -> None:
    scene = SimulatedScene(PAPER, held=True)
    start = scene.truth(np.zeros(1))[0]
    standing = [scene.scan(t).ranges_mm for t in (10.0, 40.0)]
    np.testing.assert_array_equal(scene.truth(np.array([40.0]))[0], start)
    assert np.median(np.abs(standing[0] - standing[1])) < 30
    scene.release()
    scene.scan(41.0)
    np.testing.assert_allclose(scene.truth(np.array([43.0]))[0], start, atol=1e-12)
    assert scene.truth(np.array([46.0]))[0, 0] > start[0] + 1.0
    moved = scene.scan(46.0).ranges_mm
    assert np.median(np.abs(moved - standing[0])) > 100


def test_odometry_readings_are_timed_by_the_drive() -> None:
    scene = SimulatedScene(PAPER)
    scene.scan(50.003)
    t = 50.003
    times = []
    for _ in range(250):
        reading = scene.odometry_after(t)
        assert reading is not None
        t, pose = reading
        times.append(t)
    np.testing.assert_allclose(np.diff(times), 0.02, atol=1e-9)
    moved = scene.truth(np.array([t]))[0] - scene.truth(np.array([50.003]))[0]
    assert pose[0] == pytest.approx(np.hypot(*moved[:2]), abs=0.05)


def test_unknown_lidar_names_those_there_are() -> None:
    with pytest.raises(ValueError, match=r"no lidar is called 'SICK'; there are: URG-04LX, .*UTM-30LX"):
        SimulatedScene(Scenario(lidar="SICK"))


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


def test_hybrid_model_states_the_log_s_geometry() -> None:
    model = HybridScene(recorded()).model
    assert (model.ares, model.afrt, model.amin, model.amax, model.dmax) == (360, 90, 0, 179, 81000)
    half = replace_geometry(ares=720.0, afrt=180.0, amax=360)
    model = HybridScene(recorded(geometry=half, beams=361)).model
    assert (model.ares, model.afrt, model.amax) == (720, 180, 360)


def replace_geometry(**changes: float) -> LidarGeometry:
    return replace(GEOMETRY, **changes)  # type: ignore[arg-type]  # only numbers are changed


def test_hybrid_sensor_that_looks_to_one_side() -> None:
    """First beam 10 deg left of the front: steps count from the front, the first ten are never measured."""
    model = HybridScene(recorded(geometry=replace_geometry(afrt=-10.0))).model
    assert (model.afrt, model.amin, model.amax) == (0, 10, 189)
    scene = HybridScene(recorded(geometry=replace_geometry(afrt=-10.0)))
    scan = scene.scan(float(scene.starts[0]))
    assert scan is not None
    assert scan.ranges_mm.shape == (190,)


@pytest.mark.parametrize("geometry", [replace_geometry(ares=359.5), replace_geometry(afrt=89.6)])
def test_hybrid_refuses_beams_between_steps(geometry: LidarGeometry) -> None:
    with pytest.raises(ValueError, match="do not fall on whole steps"):
        HybridScene(recorded(geometry=geometry))


def test_hybrid_needs_scans_of_one_shape_in_time() -> None:
    with pytest.raises(ValueError, match="no scans"):
        HybridScene([RawOdometry(0.0, 0.0, 0.0, 0.0, 0.0)])
    records = recorded()
    with pytest.raises(ValueError, match="do not rise"):
        HybridScene([*records, records[1]])
    with pytest.raises(ValueError, match=r"180 and of \[90\] beams"):
        HybridScene([*records, *recorded(beams=90)])


def test_hybrid_truth_is_the_reference_or_the_odometry() -> None:
    scene = HybridScene(recorded(), even=False)
    assert scene.truth(np.array([10.21]))[0].tolist() == pytest.approx([0.1, 0.0, 0.01])
    reference = Trajectory(np.array([0.0, 20.0]), np.array([[0.0, 0.0, 3.0], [2.0, 4.0, -3.0]]))
    pose = HybridScene(recorded(), reference).truth(np.array([10.0]))[0]
    assert pose[:2].tolist() == [1.0, 2.0]
    assert np.cos(pose[2]) == pytest.approx(-1.0)  # the short way round
    silent = HybridScene([record for record in recorded() if isinstance(record, RawScan)])
    assert silent.odometry_after(0.0) is None
    with pytest.raises(ValueError, match="no truth"):
        silent.truth(np.array([0.0]))


def test_hybrid_odometry_comes_in_order() -> None:
    scene = HybridScene(recorded(), even=False)
    t, times = 0.0, []
    while (reading := scene.odometry_after(t)) is not None:
        t = reading[0]
        times.append(t)
    assert times == pytest.approx([10.0, 10.21, 10.4, 10.61, 10.8])


def test_hybrid_keeps_the_rhythm_or_evens_it_out_for_everything() -> None:
    """A log whose scans come after 0.19 and 0.21 s in turn: even, wheels and truth move with the scans."""
    uneven, even = HybridScene(recorded(), even=False), HybridScene(recorded())
    np.testing.assert_allclose(uneven.starts, [10.0, 10.21, 10.4, 10.61, 10.8])
    np.testing.assert_allclose(even.starts, [10.0, 10.2, 10.4, 10.6, 10.8])
    np.testing.assert_allclose(even.truth(even.starts), uneven.truth(uneven.starts), atol=1e-12)
    rotor = even.rotor()
    assert [rotor.start_of(k) for k in range(3)] == pytest.approx([10.0, 10.2, 10.4])
