"""Device units to SI: signs, frames, codes, masks, stamps, and odometry that jumps, pauses or runs backwards."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.config.schema import LidarConfig, Mask, Mount
from daemon.devices.conversion import ImuBridge, OdometryBridge, SampleBridge, ScanBridge, in_sector, range_facts
from estimator.cdma.air_interface import PROFILE_A
from estimator.measurements import Beam
from estimator.numerics import se2
from hal.adc import Blemish
from hal.imu import RawImu
from hal.lidar import VALID, LidarGeometry, RawScan
from hal.odometry import RawOdometry
from tests.daemon.support.light_room import raw_block
from tests.daemon.support.room import URG


def scan_of(code: list[int], ranges: list[int], geometry: LidarGeometry = URG, first_step: int = 384) -> RawScan:
    return RawScan(
        geometry=geometry,
        seq=7,
        t_rx=10.1,
        t_mono=10.0,
        t_sigma=0.001,
        t_tick=0,
        first_step=first_step,
        stride=1,
        ranges=np.array(ranges, dtype=np.int32),
        code=np.array(code, dtype=np.int32),
    )


def test_metres_bearings_and_beam_times() -> None:
    scan = ScanBridge(LidarConfig()).scan(scan_of([VALID] * 3, [1000, 2000, 3000]))
    assert scan.range_m.tolist() == [1.0, 2.0, 3.0]
    np.testing.assert_allclose(scan.bearing_rad, np.arange(3) * 2 * math.pi / 1024)
    assert scan.t_begin == 10.0
    assert scan.t_end == pytest.approx(10.0 + 2 * 0.1 / 1024)
    assert (scan.seq, scan.sigma_m) == (7, 0.01)


def test_the_mount_is_in_metres_and_radians() -> None:
    config = LidarConfig(mount=Mount(x=0.2, y=-0.1, yaw=90.0))
    np.testing.assert_allclose(ScanBridge(config).scan(scan_of([VALID], [500])).T_base_lidar, [0.2, -0.1, math.pi / 2])


def test_an_inverted_lidar_sees_its_left_on_the_right() -> None:
    """Turned over about its front axis: a step counter-clockwise on the device is clockwise on the robot."""
    scan = ScanBridge(LidarConfig(mount=Mount(inverted=True))).scan(scan_of([VALID] * 2, [1000] * 2, first_step=640))
    assert scan.bearing_rad[0] == pytest.approx(-math.pi / 2)
    assert scan.bearing_rad[1] < scan.bearing_rad[0]


def test_codes_never_become_distances() -> None:
    """C-42-03320B: below dmin a value is an error code, above dmax there was no return."""
    scan = ScanBridge(LidarConfig()).scan(scan_of([0, 7, 19, 65533, VALID], [0, 0, 0, 0, 400]))
    assert scan.beam.tolist() == [Beam.NONE] * 4 + [Beam.HIT]


def test_no_return_is_free_space_only_where_the_data_sheet_promises_it() -> None:
    ust = replace(URG, model="UST-10LX", dmax=30000)
    scan = ScanBridge(LidarConfig()).scan(scan_of([65533, 4, VALID], [0, 0, 900], ust))
    assert scan.beam.tolist() == [Beam.FREE, Beam.NONE, Beam.HIT]
    assert scan.range_m[0] == 4.0


@pytest.mark.parametrize(
    ("model", "sigma_m"),
    [("UST-20LX", 0.03), ("UTM-30LX-EW", 0.01), ("URG-04LX", 0.01), ("UHG-08LX", 0.02), ("SICK LMS 2xx", 0.02)],
)
def test_range_noise_goes_by_model(model: str, sigma_m: float) -> None:
    assert range_facts(model).sigma_m == sigma_m


def test_masked_sectors_and_near_returns_make_no_statement() -> None:
    config = LidarConfig(mask=Mask(sectors=((-1.0, 0.2),), near=0.3))
    scan = ScanBridge(config).scan(scan_of([VALID, VALID, VALID, 65533], [1000, 1000, 299, 0]))
    assert scan.beam.tolist() == [Beam.NONE, Beam.HIT, Beam.NONE, Beam.NONE]


def test_the_mask_is_in_the_devices_own_frame_even_when_inverted() -> None:
    config = LidarConfig(mount=Mount(inverted=True), mask=Mask(sectors=((80.0, 100.0),)))
    scan = ScanBridge(config).scan(scan_of([VALID], [1000], first_step=640))  # +90 deg on the device
    assert scan.beam.tolist() == [Beam.NONE]


@pytest.mark.parametrize(
    ("begin", "end", "inside", "outside"),
    [
        (-10, 10, [-10, 0, 10], [11, 180, -11]),
        (170, -170, [170, 180, -180, -170], [0, 169, -169]),
        (10, -10, [10, 180, -10], [0, 9, -9]),
        (-180, 180, [0, 180, -180], []),
        (-90, 360, [0, 180, -91], []),
    ],
)
def test_sectors_run_counter_clockwise(begin: float, end: float, inside: list[float], outside: list[float]) -> None:
    assert in_sector(np.array(inside, dtype=float), begin, end).all()
    assert not in_sector(np.array(outside, dtype=float), begin, end).any()


def test_intensity_is_kept_as_the_device_gave_it() -> None:
    raw = replace(scan_of([VALID], [100]), intensity=np.array([4711], dtype=np.int32))
    intensity = ScanBridge(LidarConfig()).scan(raw).intensity
    assert intensity is not None
    assert intensity.tolist() == [4711.0]


def test_scans_of_changing_size_each_get_their_own_bearings() -> None:
    """Real logs change their beam count in the middle."""
    bridge = ScanBridge(LidarConfig())
    for count in (3, 5, 3):
        assert len(bridge.scan(scan_of([VALID] * count, [100] * count)).bearing_rad) == count


# odometry


def reading(t: float, x: float, y: float = 0.0, yaw: float = 0.0, late: float = 0.0) -> RawOdometry:
    return RawOdometry(t + late, t, x, y, yaw)


def test_the_first_reading_is_a_reference_not_a_motion() -> None:
    assert OdometryBridge().increment(reading(0.0, 5.0)) is None


poses = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.2, 0.2), st.floats(-0.5, 0.5))


@given(moves=st.lists(poses, min_size=1, max_size=30), start=poses)
def test_increments_add_up_to_the_whole_motion(
    moves: list[tuple[float, float, float]], start: tuple[float, float, float]
) -> None:
    bridge, pose = OdometryBridge(), np.array(start)
    bridge.increment(RawOdometry(0.0, 0.0, *pose.tolist()))
    total = se2.identity()
    for number, move in enumerate([*moves, *[(0.0, 0.0, 0.0)] * 8], 1):  # it rests at the end, and nothing is held back
        pose = se2.compose(pose, np.array(move))
        increment = bridge.increment(RawOdometry(number * 0.1, number * 0.1, *pose.tolist()))
        total = total if increment is None else se2.compose(total, increment.delta)
    assert not bridge.jumps
    expected = se2.between(np.array(start), pose)
    np.testing.assert_allclose(total[:2], expected[:2], atol=1e-9)
    assert math.isclose(math.cos(total[2] - expected[2]), 1.0, abs_tol=1e-9)


def test_a_jump_is_no_motion_and_is_counted() -> None:
    """The sender has begun anew; the readings before that is certain are no motion either."""
    bridge = OdometryBridge()
    bridge.increment(reading(0.0, 100.0))
    said = [bridge.increment(reading(0.1 * k, 0.01 * k)) for k in range(1, 10)]
    assert bridge.jumps == 1
    moved = [increment.delta for increment in said if increment is not None]
    assert len(moved) == 4
    np.testing.assert_allclose(moved, [[0.01, 0.0, 0.0]] * 4, atol=1e-12)


def test_a_restart_after_a_long_pause_is_still_a_jump() -> None:
    bridge = OdometryBridge()
    bridge.increment(reading(0.0, 100.0))
    assert bridge.increment(reading(600.0, 0.0)) is None
    after = bridge.increment(reading(600.6, 0.01))
    assert bridge.jumps == 1
    assert after is not None
    np.testing.assert_allclose(after.delta, [0.01, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize("wrong", [(0.5, 0.0, 2.9), (0.0, 0.0, 0.52), (1.5, 0.0, 0.0), (90.0, -3.0, 1.0)])
@pytest.mark.parametrize("readings", [1, 2])
def test_a_wrong_reading_is_bridged_from_the_last_good_one(wrong: tuple[float, float, float], readings: int) -> None:
    """An encoder spike, a gyro glitch: the readings before and after it explain each other."""
    bridge = OdometryBridge()
    total = se2.identity()
    for k in range(20):
        pose = np.array((0.05 * k, 0.0, 0.0))
        if 10 <= k < 10 + readings:
            pose = se2.compose(pose, np.array(wrong))
        increment = bridge.increment(RawOdometry(0.1 * k, 0.1 * k, *pose.tolist()))
        total = total if increment is None else se2.compose(total, increment.delta)
    np.testing.assert_allclose(total, [0.95, 0.0, 0.0], atol=1e-12)
    assert not bridge.jumps


def test_a_jump_with_stamps_that_stand_still_ends_too() -> None:
    bridge = OdometryBridge()
    bridge.increment(reading(5.0, 0.0))
    said = [bridge.increment(RawOdometry(5.0 + 0.1 * k, 5.0, 50.0 + 0.01 * k, 0.0, 0.0)) for k in range(1, 10)]
    assert bridge.jumps == 1
    assert said[-1] is not None


def test_wheels_that_spin_are_followed() -> None:
    """No acceleration of a robot explains it, but reading after reading says so."""
    bridge, total = OdometryBridge(), se2.identity()
    for k in range(30):
        increment = bridge.increment(reading(0.1 * k, 0.0, yaw=0.9 * max(0, min(k, 20) - 10)))
        total = total if increment is None else se2.compose(total, increment.delta)
    assert math.cos(total[2] - 9.0) == pytest.approx(1.0)


def test_what_moved_while_datagrams_were_lost_is_not_lost() -> None:
    bridge = OdometryBridge()
    bridge.increment(reading(0.0, 0.0))
    increment = bridge.increment(reading(1.5, 1.2))
    assert increment is not None
    assert (increment.t_begin, increment.t_end, increment.delta[0]) == (0.0, 1.5, 1.2)


def test_stamps_that_run_backwards_or_ahead_lose_no_motion() -> None:
    bridge = OdometryBridge()
    bridge.increment(reading(1.0, 0.0))
    back = bridge.increment(reading(0.9, 0.1))
    ahead = bridge.increment(reading(1.3, 0.2, late=-0.2))
    assert back is not None
    assert ahead is not None
    assert (back.t_begin, back.t_end, back.delta[0]) == (1.0, 1.0, 0.1)
    assert (ahead.t_begin, ahead.t_end) == (1.0, pytest.approx(1.1))


@pytest.mark.parametrize("wrong", [math.nan, math.inf])
def test_readings_that_are_no_numbers_are_counted_and_left_out(wrong: float) -> None:
    bridge, imu = OdometryBridge(), ImuBridge()
    bridge.increment(reading(0.0, 0.0))
    assert bridge.increment(reading(0.1, wrong)) is None
    assert bridge.invalid == 1
    after = bridge.increment(reading(0.2, 0.1))
    assert after is not None
    assert after.t_begin == 0.0
    assert imu.turn(RawImu(0.0, 0.0, wrong)) is None
    assert imu.invalid == 1


def test_yaw_rates_become_turns() -> None:
    imu = ImuBridge()
    assert imu.turn(RawImu(0.0, 0.0, 0.0)) is None
    turn = imu.turn(RawImu(0.1, 0.1, 1.0))
    assert turn is not None
    assert (turn.t_begin, turn.t_end, turn.dyaw) == (0.0, 0.1, pytest.approx(0.05))
    assert imu.turn(RawImu(9.0, 9.0, 1.0)) is None, "a gap is no turn"
    assert imu.turn(RawImu(9.0, 9.0, 1.0)) is None, "no time has passed"


def test_a_block_of_samples_keeps_its_own_time_base() -> None:
    raw = raw_block(3, rate_hz=22_100.0)
    block = SampleBridge(PROFILE_A).block(raw)
    assert block is not None
    assert block.t_begin == raw.t_first
    assert block.t_end == pytest.approx(raw.t_first + 1111 / 22_100.0 + raw.slack_s)
    assert block.rate == PROFILE_A.sample_rate, "the decoder looks for the clock about the nominal rate"
    assert block.words.dtype == np.float64
    assert block.words.tolist() == raw.words.tolist()


@pytest.mark.parametrize("blemish", [Blemish.SHORT, Blemish.MISALIGNED, Blemish.STUCK, Blemish.GAP | Blemish.SHORT])
def test_words_that_the_light_never_was_are_dropped_and_counted(blemish: Blemish) -> None:
    bridge = SampleBridge(PROFILE_A)
    assert bridge.block(raw_block(0, blemish)) is None
    assert bridge.block(replace(raw_block(1), words=np.empty(0, np.uint16))) is None
    assert (bridge.unfit, bridge.stretched) == (2, 0)


@pytest.mark.parametrize("blemish", [Blemish.NONE, Blemish.CLIPPED, Blemish.GAP, Blemish.STRETCHED])
def test_the_decoder_judges_all_others(blemish: Blemish) -> None:
    bridge = SampleBridge(PROFILE_A)
    assert bridge.block(raw_block(0, blemish)) is not None
    assert (bridge.unfit, bridge.stretched) == (0, blemish is Blemish.STRETCHED)


@pytest.mark.parametrize(
    ("off", "reachable"), [(0.0, True), (0.0099, True), (-0.0115, True), (0.013, False), (-0.2, False)]
)
def test_a_clock_beyond_the_decoders_reach_is_said(off: float, reachable: bool) -> None:
    bridge = SampleBridge(PROFILE_A)
    assert not bridge.off_rate, "nothing is known yet"
    block = bridge.block(raw_block(0, rate_hz=PROFILE_A.sample_rate * (1.0 + off)))
    assert block is not None
    assert bridge.off_rate is not reachable
    assert (block.rate == PROFILE_A.sample_rate) is reachable
