"""A CARMEN log as a device: geometry, no-return values, mount, time, and everything real logs do wrong."""

import asyncio
import gzip
import math
import tracemalloc
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.clock import run_virtual
from hal.errors import DataInvalid, DeviceMissing, DeviceRefused, HalError
from hal.lidar import VALID, Link, RawScan
from hal.odometry import RawOdometry
from hal.replay.carmen import CarmenLog, read_carmen
from hal.replay.player import LEAD_S, LogPlayer
from tests.hal.replay.logs import drive, flaser, robotlaser, write


def scans_of(log: CarmenLog, start: float = 0.0) -> list[RawScan]:
    return [event for event in log.events(start) if isinstance(event, RawScan)]


def test_a_log_is_read_in_sixteen_bytes_a_beam(tmp_path: Path) -> None:
    read_carmen(write(tmp_path / "b.log", drive(3)))  # what numpy loads at its first use does not count
    path = write(tmp_path / "a.log", drive(600, count=361))
    tracemalloc.start()
    log = read_carmen(path)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    beams = 600 * 361
    assert sum(scan.ranges.size for scan in scans_of(log)) == beams
    assert held < 8 * beams
    assert peak - 4_000_000 < 16 * beams  # a part of the file is split into lines at a time


@pytest.mark.parametrize(
    ("count", "first", "step"),
    [(180, -90, 1.0), (181, -90, 1.0), (360, -90, 0.5), (361, -90, 0.5), (401, -50, 0.25), (1081, -135, 0.25)],
)
def test_beam_geometry_follows_from_the_count(tmp_path: Path, count: int, first: float, step: float) -> None:
    log = read_carmen(write(tmp_path / "a.log", drive(3, count=count)))
    bearings = log.geometry.bearings(0, 1, count)
    assert math.degrees(bearings[0]) == pytest.approx(first, abs=1e-9)
    assert np.degrees(np.diff(bearings)) == pytest.approx(np.full(count - 1, step), abs=1e-9)
    assert not log.report.notes


def test_an_unusual_count_is_an_assumption_that_is_said(tmp_path: Path) -> None:
    log = read_carmen(write(tmp_path / "a.log", drive(3, count=91)))
    assert np.degrees(log.geometry.bearings(0, 1, 91)[[0, -1]]) == pytest.approx([-90.0, 90.0])
    assert any("the replay assumes 180 deg from -90 deg" in note for note in log.report.notes)


def test_robotlaser_says_its_own_geometry(tmp_path: Path) -> None:
    angles = (-2.086214, 4.178563, 0.006136)
    log = read_carmen(write(tmp_path / "a.log", [robotlaser(10.0 + i, angles, [1.0] * 682, 5.601) for i in range(3)]))
    bearings = log.geometry.bearings(0, 1, 682)
    assert bearings == pytest.approx((np.arange(682) - 340) * 2 * math.pi / 1024, abs=2e-6)
    assert log.geometry.dmax == 5600
    assert log.geometry.afrt == 340
    assert log.mount == pytest.approx(
        (0.2 * math.cos(0.1) + 0.1 * math.sin(0.1), 0.1 * math.cos(0.1) - 0.2 * math.sin(0.1), 0),
        abs=1e-5,
    )


def test_a_front_between_two_steps(tmp_path: Path) -> None:
    lines = [robotlaser(10.0 + i, (-1.0, 2.0, 2.0 / 99), [1.0] * 100, 30.0) for i in range(3)]
    geometry = read_carmen(write(tmp_path / "a.log", lines)).geometry
    assert geometry.afrt == pytest.approx(49.5)
    assert geometry.bearings(0, 1, 100)[[0, -1]] == pytest.approx([-1.0, 1.0], abs=1e-5)


@pytest.mark.parametrize("value", [81.83, 81.91, 50.0])
def test_no_return_values_are_no_distance(tmp_path: Path, value: float) -> None:
    spread = tuple(2.0 + 0.01 * i for i in range(170))
    lines = [flaser(i, robot=(i, 0, 0), ranges=(*spread, *[value] * 10)) for i in range(5)]
    for scan in scans_of(read_carmen(write(tmp_path / "a.log", lines))):
        assert np.all(scan.ranges[170:] == 0)
        assert np.all(scan.code[170:] == round(value * 1000))
        assert np.all(scan.code[:170] == VALID)
        assert scan.ranges[:170].tolist() == [2000 + 10 * i for i in range(170)]


def test_a_far_wall_is_not_taken_for_no_return(tmp_path: Path) -> None:
    spread = tuple(2.0 + 0.01 * i for i in range(180))
    log = read_carmen(write(tmp_path / "a.log", [flaser(i, robot=(i, 0, 0), ranges=spread) for i in range(5)]))
    assert log.report.used["beams without a return"] == 0


def test_the_declared_maximum_counts_as_no_return(tmp_path: Path) -> None:
    scan = scans_of(read_carmen(write(tmp_path / "a.log", ["PARAM robot_front_laser_max 3.0 1 h 1", *drive(3)])))[0]
    assert scan.ranges[:5].tolist() == [2000, 2500, 0, 0, 0]
    assert scan.code[:5].tolist() == [VALID, VALID, 3000, 3250, 81830]


def test_readings_that_are_no_numbers(tmp_path: Path) -> None:
    line = flaser(1.0)
    for written, wrong in (("2.00", "nan"), ("2.50", "inf"), ("3.00", "-1.0"), ("3.25", "1e300")):
        line = line.replace(written, wrong, 1)
    (scan,) = scans_of(read_carmen(write(tmp_path / "a.log", [line])))
    assert scan.ranges[:4].tolist() == [0, 0, 0, 0]
    assert scan.code[:3].tolist() == [0, 0, 0]
    assert scan.code[3] > scan.geometry.dmax


def test_the_mount_is_the_difference_of_the_two_poses(tmp_path: Path) -> None:
    lines = []
    for i in range(20):
        yaw = 0.3 * i
        x, y = math.cos(yaw) * 0.15 - math.sin(yaw) * 0.02, math.sin(yaw) * 0.15 + math.cos(yaw) * 0.02
        lines.append(flaser(i, robot=(i, 0.0, yaw), laser=(i + x, y, yaw + 0.1)))
    log = read_carmen(write(tmp_path / "a.log", lines))
    assert log.mount == pytest.approx((0.15, 0.02, 0.1), abs=1e-5)
    assert not log.report.notes


def test_a_corrected_log_has_no_mount_in_its_poses(tmp_path: Path) -> None:
    lines = [flaser(i, robot=(i, 0.0, 0.0), laser=(i + 0.05 * i, 0.1, 0.01 * i)) for i in range(20)]
    plain = read_carmen(write(tmp_path / "a.log", lines))
    assert plain.mount == (0.0, 0.0, 0.0)
    assert any("lidar and robot pose have no constant offset on" in note for note in plain.report.notes)
    stated = read_carmen(write(tmp_path / "b.log", ["PARAM robot_frontlaser_offset 0.2", *lines]))
    assert stated.mount == (0.2, 0.0, 0.0)


def test_poses_and_parameters_that_disagree_are_reported(tmp_path: Path) -> None:
    log = read_carmen(write(tmp_path / "a.log", ["PARAM robot_frontlaser_offset 0.2", *drive(5)]))
    assert log.mount == (0.0, 0.0, 0.0)
    assert any("by the parameters" in note for note in log.report.notes)


def play(path: Path) -> tuple[list[tuple[float, object]], LogPlayer]:
    """Everything a log delivers with the virtual time of its delivery."""
    log = read_carmen(path)
    seen: list[tuple[float, object]] = []

    async def main() -> LogPlayer:
        player = LogPlayer(log)
        loop = asyncio.get_running_loop()
        listening = asyncio.create_task(player.odometry.run(lambda reading: seen.append((loop.time(), reading))))
        await player.lidar.run(lambda scan: seen.append((loop.time(), scan)))
        await listening
        return player

    player = run_virtual(main())
    return seen, player


def test_playing_keeps_file_order_and_monotone_time(tmp_path: Path) -> None:
    stamps = [10.0, 10.2, 10.1, 10.1, 10.5]
    path = write(tmp_path / "a.log", [flaser(t, robot=(i, 0.0, 0.0)) for i, t in enumerate(stamps)])
    seen, player = play(path)
    times = [t for t, _ in seen]
    assert times == sorted(times)
    assert [type(event) for _, event in seen] == [RawOdometry, RawScan] * 5
    assert [event.seq for _, event in seen if isinstance(event, RawScan)] == [0, 1, 2, 3, 4]
    assert [event.x for _, event in seen if isinstance(event, RawOdometry)] == [0, 1, 2, 3, 4]
    assert times[0] == LEAD_S
    scan_times = np.array([t for t, event in seen if isinstance(event, RawScan)])
    assert np.all(np.diff(scan_times) >= 0.999e-3)
    assert read_carmen(path).stamps.tolist() == stamps
    assert player.lidar.status.scans == 5
    assert player.lidar.status.link is Link.CLOSED
    assert player.lidar.geometry is not None


@pytest.mark.parametrize("swapped", [1, 3])
def test_scans_out_of_order_are_put_in_the_order_that_the_wheels_fit(tmp_path: Path, swapped: int) -> None:
    """The same stamps with the wheels in file order keep that order: then the stamps are wrong."""
    order = list(range(10))
    for k in range(swapped):
        order[3 * k], order[3 * k + 1] = order[3 * k + 1], order[3 * k]
    path = write(tmp_path / "a.log", [flaser(10.0 + 0.1 * i, robot=(0.1 * i, 0.0, 0.0)) for i in order])
    log = read_carmen(path)
    np.testing.assert_allclose(log.stamps, 10.0 + 0.1 * np.arange(10))
    assert any("out of order" in note for note in log.report.notes)
    kept = write(tmp_path / "b.log", [flaser(10.0 + 0.1 * i, robot=(0.1 * n, 0.0, 0.0)) for n, i in enumerate(order)])
    np.testing.assert_allclose(read_carmen(kept).stamps, [10.0 + 0.1 * i for i in order])


def test_a_clock_set_back_in_a_closed_drive_reorders_nothing(tmp_path: Path) -> None:
    """The second half before the first makes a shorter path where the drive ends at its start."""
    x = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 8.0, 7.0, 6.0, 5.0, 4.0, 3.0, 2.0, 1.0, 0.5, 0.0]
    stamps = [10.0 + 0.1 * k - 50.0 * (k >= 10) for k in range(20)]
    log = read_carmen(write(tmp_path / "a.log", [flaser(t, robot=(x[k], 0.0, 0.0)) for k, t in enumerate(stamps)]))
    assert log.stamps.tolist() == stamps


def test_separate_odometry_is_used_where_laser_lines_have_none(tmp_path: Path) -> None:
    raw = "RAWLASER1 4 -1.570796 3.141593 0.017453 81.92 0.01 0 3 1.0 2.0 3.0 0 {t:.3f} h {t:.3f}"
    lines = []
    for i in range(5):
        lines += [f"ODOM {i} 0 0 0 0 0 {10 + i:.3f} h 0", raw.format(t=10.5 + i)]
    seen, _ = play(write(tmp_path / "a.log", lines))
    assert [type(event) for _, event in seen] == [RawOdometry, RawScan] * 5
    assert [round(t - seen[0][0], 3) for t, _ in seen[:4]] == [0.0, 0.5, 1.0, 1.5]
    assert seen[0][0] == LEAD_S


def test_a_log_without_odometry_delivers_none_and_says_so(tmp_path: Path) -> None:
    path = write(tmp_path / "a.log", [flaser(10.0 + i) for i in range(5)])
    seen, _ = play(path)
    assert all(isinstance(event, RawScan) for _, event in seen)
    assert any("no wheel odometry" in note for note in read_carmen(path).report.notes)


def test_beam_times_of_a_converted_log_delay_the_delivery(tmp_path: Path) -> None:
    own = ["beam_dt 0.0001", "period 0.1", "model X", "dmin 0.3"]
    log = read_carmen(write(tmp_path / "a.log", [f"PARAM lumiloop_laser_{line}" for line in own] + drive(3)))
    scan = scans_of(log, 7.0)[0]
    assert scan.t_mono == 7.0
    assert scan.t_rx == pytest.approx(7.0 + 179e-4)
    assert (scan.geometry.period_s, scan.geometry.model, scan.geometry.dmin) == (0.1, "X", 300)


@pytest.mark.parametrize(
    ("stamps", "says"),
    [
        ([0.0] * 20, "all 20 stamps are equal"),
        ([20.0 - 0.1 * i for i in range(20)], "19 run back"),
        ([100.0 * i for i in range(20)], "cannot be seconds"),
    ],
)
def test_a_log_without_usable_time_is_refused(tmp_path: Path, stamps: list[float], says: str) -> None:
    path = write(tmp_path / "a.log", [flaser(t, robot=(i, 0.0, 0.0)) for i, t in enumerate(stamps)])
    with pytest.raises(DataInvalid, match=says) as caught:
        read_carmen(path)
    assert str(path) in str(caught.value)
    assert "in seconds" in caught.value.remedy


def test_whole_seconds_and_a_set_clock_are_read_right_and_said(tmp_path: Path) -> None:
    true = [0.1 * i for i in range(100)]
    whole = read_carmen(write(tmp_path / "a.log", [flaser(int(t), robot=(t, 0, 0)) for t in true]))
    assert np.ptp(whole.time - true) < 0.11
    assert np.all(np.diff(whole.stamps) > 0.05)
    assert any("clock steps by 1 s" in note for note in whole.report.notes)
    late = [flaser(1e9 + t - 3.0 * (t > 5.05), robot=(t, 0, 0)) for t in true]
    bridged = read_carmen(write(tmp_path / "b.log", late))
    assert bridged.time == pytest.approx(true, abs=1e-5)
    assert any("was set 1 times" in note for note in bridged.report.notes)


def test_odometry_lines_of_one_stamp_are_not_used(tmp_path: Path) -> None:
    lines = [f"ODOM {i} 0 0 0 0 0 7.0 h 0" for i in range(5)]
    log = read_carmen(write(tmp_path / "a.log", [*lines, *(flaser(10.0 + i) for i in range(5))]))
    assert not log.has_odometry
    assert any("one stamp" in note for note in log.report.notes)


def test_broken_lines_are_skipped_with_their_numbers(tmp_path: Path) -> None:
    lines = ["# a comment", *drive(30), "PARAM"]
    lines[3] = lines[3][:200]
    lines[5] += " " + lines[6]
    lines[8] = flaser(100.7, count=179, robot=(0.07, 0, 0))
    log = read_carmen(write(tmp_path / "a.log.gz", lines, end=""))  # and the last line has no end
    assert len(log.stamps) == 27
    assert sum(entry.count for entry in log.report.skipped.values()) == 4
    assert {4, 6, 32} <= {line for entry in log.report.skipped.values() for line in entry.first}
    assert "179 beams" in " ".join(log.report.sentences())


def test_a_last_line_that_was_cut_costs_only_itself(tmp_path: Path) -> None:
    path = tmp_path / "a.log"
    path.write_text("\n".join(drive(5))[:-40])
    log = read_carmen(path)
    assert len(log.stamps) == 4
    assert [entry.first for entry in log.report.skipped.values()] == [[5]]


def test_a_torn_gzip_keeps_what_it_holds(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    lines = [flaser(i, robot=(i, 0, 0), ranges=tuple(rng.uniform(1, 9, 180))) for i in range(400)]
    data = gzip.compress("\n".join(lines).encode())
    path = tmp_path / "a.log.gz"
    path.write_bytes(data[: len(data) // 2])
    log = read_carmen(path)
    assert 100 < len(log.stamps) < 300
    assert any("incomplete" in note for note in log.report.notes)
    damaged = bytearray(data)
    damaged[-6] ^= 0xFF  # the checksum at the end
    path.write_bytes(damaged)
    log = read_carmen(path)
    assert len(log.stamps) == 400
    assert any("incomplete" in note for note in log.report.notes)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "the file is empty"),
        (gzip.compress(b"", mtime=0), "the file is empty"),
        (gzip.compress(b"FLASER 3 1 2 3", mtime=0)[:6], "incomplete"),
        (b"\n\n# only comments\n", "not a CARMEN log"),
        (b"PARAM a b\n", "not a CARMEN log"),
        (b"ODOM 1 2 3 0 0 0 1 h 1\n", "has no usable scan line"),
        (b"<html>\n" * 1200, "not a CARMEN log: unknown kind"),
        (b"FLASER 3 1 2\n", "not a CARMEN log"),
        (b"x" * (5 << 20), "4 MB"),
        (bytes(range(256)) * 40, "not a CARMEN log"),
    ],
)
def test_what_is_no_log_is_refused_by_name(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "a.log"
    path.write_bytes(content)
    with pytest.raises(DataInvalid, match=says) as caught:
        read_carmen(path)
    assert str(path) in str(caught.value)
    assert caught.value.remedy


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(DeviceMissing, match="no such file"):
        read_carmen(tmp_path / "missing.log")
    with pytest.raises(DeviceRefused, match="is a folder"):
        read_carmen(tmp_path)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_damage_gives_a_log_or_a_clear_error(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    content = bytearray("\n".join(drive(4, count=5)).encode())
    for _ in range(data.draw(st.integers(1, 30))):
        at = data.draw(st.integers(0, len(content) - 1))
        content[at] = data.draw(st.integers(0, 255))
    path = tmp_path_factory.mktemp("log") / "a.log"
    path.write_bytes(content)
    try:
        events = list(read_carmen(path).events(0.0))
    except HalError as error:
        events, told = [], error.remedy
    else:
        told = "played"
    assert told
    assert all(b.t_rx >= a.t_rx for a, b in pairwise(events))


def test_the_intel_log(log_root: Path) -> None:
    log = read_carmen(log_root / "intel" / "intel.clf.gz")
    assert len(log.stamps) == 13631
    assert log.report.used["beams without a return"] == 68313
    assert any("backwards 564 times, by 0.908 s" in note for note in log.report.notes)
    assert log.mount == (0.0, 0.0, 0.0)
    assert log.geometry.dmax == 81829
    assert np.degrees(log.geometry.bearings(0, 1, 180)[[0, 179]]) == pytest.approx([-90.0, 89.0])
    odometry = [event for event in log.events(0.0) if isinstance(event, RawOdometry)]
    driven = sum(math.hypot(b.x - a.x, b.y - a.y) for a, b in pairwise(odometry))
    assert driven == pytest.approx(508.35, abs=0.01)


def test_the_aces_log(log_root: Path) -> None:
    log = read_carmen(log_root / "aces" / "aces.clf.gz")
    assert len(log.stamps) == 7374
    assert log.report.used["beams without a return"] == 11137
    assert not log.report.notes
