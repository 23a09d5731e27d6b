"""Recorded data of other formats become logs that say the same."""

import gzip
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from daemon.cli import parser
from daemon.replay import convert
from hal.lidar import VALID, RawScan
from hal.odometry import RawOdometry
from hal.replay.carmen import CarmenLog, read_carmen
from tests.commands import Command

RNG = np.random.default_rng(3)


def dat_lines(
    stamps: npt.NDArray[np.float64], counts: npt.NDArray[np.int64], ranges: npt.NDArray[np.int64]
) -> list[str]:
    rows = []
    for stamp, count, values in zip(stamps, counts, ranges, strict=True):
        rows.append(" ".join(map(str, [round(1e6 * stamp), 0, *count, *[0] * 20, *values, 0])))
    return rows


def write_dat(path: Path, scans: int = 40) -> npt.NDArray[np.int64]:
    ranges = RNG.integers(20, 5601, (scans, 682))
    ranges[:, 100:120] = 0
    counts = np.column_stack([np.arange(scans) * 300, np.arange(scans) * 340])
    text = "\n".join(dat_lines(100.0 + 0.1 * np.arange(scans), counts, ranges)) + "\n"
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())
    return ranges


def scans_of(log: CarmenLog) -> list[RawScan]:
    return [event for event in log.events(0.0) if isinstance(event, RawScan)]


@pytest.mark.parametrize("name", ["a.dat", "a.dat.gz"])
def test_every_range_of_a_dat_file_comes_out_of_the_log(tmp_path: Path, name: str) -> None:
    ranges = write_dat(tmp_path / name)
    assert parser.main(["convert", str(tmp_path / name), str(tmp_path / "b.log.gz"), "--all", "--logged"]) == 0
    log = read_carmen(tmp_path / "b.log.gz")
    assert not log.report.skipped
    assert log.mount == pytest.approx((0.145, 0.0, 0.0), abs=1e-6)
    found = scans_of(log)
    assert np.array_equal([scan.ranges for scan in found], ranges)
    assert all(np.array_equal(scan.code == VALID, row > 0) for scan, row in zip(found, ranges, strict=True))
    geometry = log.geometry
    assert (geometry.model, geometry.dmin, geometry.dmax, geometry.afrt) == ("URG-04LX", 20, 5600, 340)
    assert geometry.bearings(0, 1, 682) == pytest.approx((np.arange(44, 726) - 384) * 2 * math.pi / 1024, abs=1e-8)
    assert log.stamps == pytest.approx(100.0 + 0.1 * np.arange(40), abs=1e-6)
    assert geometry.beam_dt_s == pytest.approx(0.1 / 1024)


def test_beams_that_see_the_rover_and_far_ranges_go_by_default(tmp_path: Path) -> None:
    ranges = write_dat(tmp_path / "a.dat")
    assert parser.main(["convert", str(tmp_path / "a.dat"), str(tmp_path / "b.log")]) == 0
    found = np.array([scan.ranges for scan in scans_of(read_carmen(tmp_path / "b.log"))])
    kept = np.zeros_like(ranges, dtype=bool)
    kept[:, 70:612] = True
    assert np.array_equal(found, np.where(kept & (ranges <= 4000), ranges, 0))


def test_wheels_straight_and_on_the_spot() -> None:
    count_m = 2 * math.pi * 0.077 / 2000
    straight = convert.wheel_poses(np.array([(5.0, 9.0), (105.0, 109.0), (305.0, 309.0)]))
    assert straight == pytest.approx(np.array([(0, 0, 0), (100 * count_m, 0, 0), (300 * count_m, 0, 0)]))
    quarter = 0.165 * math.pi / 2 / count_m
    spot = convert.wheel_poses(np.array([(0.0, 0.0), (-quarter, quarter)]))
    assert spot[-1] == pytest.approx((0.0, 0.0, math.pi / 2), abs=1e-12)
    arc = convert.wheel_poses(np.array([(0.0, 0.0), (quarter, 3 * quarter)]))
    assert arc[-1] == pytest.approx((0.33, 0.33, math.pi / 2), abs=1e-12)  # a quarter circle of twice the half track


def test_arrivals_tell_the_turns_of_the_motor() -> None:
    turns = np.delete(np.arange(300), [90, 200])
    true = 50.0 + 0.0987 * turns
    late = RNG.uniform(-0.03, 0.03, len(turns))
    late[150], late[151], late[152] = 0.16, 0.10, 0.03  # a burst: three scans after a pause
    arrivals = true + late
    poses = np.column_stack([arrivals, np.zeros_like(arrivals), np.zeros_like(arrivals)])
    laser = convert.Laser("URG-04LX", 0.0, 0.1, 20, 5600, 0.1, 1e-4)
    even = convert.even_stamps(convert.Scans(laser, arrivals, np.zeros((len(turns), 1), np.int64), poses), 0.05)
    assert even.laser.period == pytest.approx(0.0987, abs=2e-5)
    assert np.abs(even.stamps - (true - 0.05)).max() < 0.006
    assert even.poses[5:-5, 0] == pytest.approx(even.stamps[5:-5], abs=1e-9)  # the wheels at the scan's own instant
    steps = np.rint(np.diff(even.stamps) / even.laser.period)
    assert np.flatnonzero(steps == 2).tolist() == [89, 198]
    assert set(steps.tolist()) == {1.0, 2.0}


def write_npz(path: Path, **changes: object) -> npt.NDArray[np.uint16]:
    ranges = RNG.integers(23, 30_000, (20, 1081)).astype(np.uint16)
    ranges[:, 500:510] = 1
    arrays: dict[str, object] = {
        "t_device_s": 1.7e9 + 0.025 * np.arange(20),
        "range_mm": ranges,
        "angle_min_rad": -2.3561945,
        "angle_increment_rad": 0.004363323,
        "time_increment_s": 1.736e-5,
    }
    np.savez(path, **{**arrays, **changes})  # type: ignore[arg-type]  # arrays by name
    return ranges


def test_an_npz_becomes_a_log_without_wheels(tmp_path: Path) -> None:
    ranges = write_npz(tmp_path / "a.npz")
    assert parser.main(["convert", str(tmp_path / "a.npz"), str(tmp_path / "b.log")]) == 0
    log = read_carmen(tmp_path / "b.log")
    found = scans_of(log)
    assert np.array_equal([scan.ranges for scan in found], np.where(ranges >= 23, ranges, 0))
    assert found[0].code[500] == 1
    assert not log.has_odometry
    assert not any(isinstance(event, RawOdometry) for event in log.events(0.0))
    assert (log.geometry.model, log.geometry.afrt) == ("UTM-30LX", 540)
    assert log.geometry.ares == pytest.approx(1440, abs=1e-3)
    assert log.geometry.period_s == pytest.approx(0.025, abs=1e-4)


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "No such file"),
        (b"", "the file is empty"),
        (b"1 2 3\n", r"a\.dat:1: 3 fields; a scan of this format has 707"),
        (b"x " * 707 + b"\n", r"a\.dat:1: could not convert"),
        (b"nan " * 707 + b"\n", r"a\.dat:1: a field is not a number"),
        (b"1 2 3\n" * 1000, r"a\.dat:1: 3 fields"),
        ((b"5 " * 707 + b"\n") * 40, "all 40 stamps are equal"),
        (gzip.compress(b"1 2 3\n", mtime=0)[:12], "a.dat"),
        (b"PK\x03\x04 but no archive", "expected the arrays"),
    ],
)
def test_what_cannot_be_converted_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None, says: str
) -> None:
    path = tmp_path / "a.dat"
    if content is not None:
        path.write_bytes(content)
    assert parser.main(["convert", str(path), str(tmp_path / "b.log")]) == 1
    with pytest.raises(convert.NotConverted, match=says):
        convert.read(path)
    assert "lumiloop: " in capsys.readouterr().err
    assert not (tmp_path / "b.log").exists()


def test_a_log_that_is_read_as_it_is_needs_no_conversion(tmp_path: Path, refused: Command) -> None:
    write_dat(tmp_path / "a.dat")
    assert parser.main(["convert", str(tmp_path / "a.dat"), str(tmp_path / "b.log")]) == 0
    said = refused("convert", str(tmp_path / "b.log"), str(tmp_path / "c.log"))
    assert "b.log: a CARMEN log needs no conversion" in said
    assert "lumiloop replay" in said


@pytest.mark.parametrize("name", ["a.dat", "a.dat.gz"])
def test_a_torn_end_costs_the_last_line(tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str) -> None:
    ranges = write_dat(tmp_path / "whole.dat")
    torn = (tmp_path / "whole.dat").read_bytes()[:-150]
    (tmp_path / name).write_bytes(gzip.compress(torn) if name.endswith(".gz") else torn)
    words = ["convert", str(tmp_path / name), str(tmp_path / "b.log"), "--all", "--logged"]
    assert parser.main(words) == 0
    assert np.array_equal([scan.ranges for scan in scans_of(read_carmen(tmp_path / "b.log"))], ranges[:-1])
    assert "skipped 1" in capsys.readouterr().err
    (tmp_path / name).write_bytes(torn.replace(b" ", b" x", 1))  # and the first line is damaged
    assert parser.main(words) == 0
    assert np.array_equal([scan.ranges for scan in scans_of(read_carmen(tmp_path / "b.log"))], ranges[1:-1])


def test_a_compressed_file_that_breaks_off_gives_what_it_holds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    ranges = write_dat(tmp_path / "a.dat.gz", 400)
    data = (tmp_path / "a.dat.gz").read_bytes()
    (tmp_path / "a.dat.gz").write_bytes(data[: len(data) // 2])
    assert parser.main(["convert", str(tmp_path / "a.dat.gz"), str(tmp_path / "b.log"), "--all", "--logged"]) == 0
    found = scans_of(read_carmen(tmp_path / "b.log"))
    assert 100 < len(found) < 300
    assert np.array_equal([scan.ranges for scan in found], ranges[: len(found)])
    assert "incomplete" in capsys.readouterr().err


def test_a_host_clock_of_whole_seconds_or_set_back(tmp_path: Path) -> None:
    write_dat(tmp_path / "a.dat", 200)
    lines = (tmp_path / "a.dat").read_text().splitlines()
    true = 0.1 * np.arange(200)

    def times(stamps: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        told = [f"{round(1e6 * t)} {line.partition(' ')[2]}" for t, line in zip(stamps, lines, strict=True)]
        (tmp_path / "b.dat").write_text("\n".join(told) + "\n")
        scans = convert.even_stamps(convert.read(tmp_path / "b.dat"), 0.0)
        assert any("clock" in note for note in scans.report.notes)
        assert np.all(np.diff(scans.poses[5:-5, 0]) != 0.0)
        return scans.stamps - scans.stamps[0]

    assert times(np.floor(100.0 + true)) == pytest.approx(true, abs=0.06)
    assert times(100.0 + true - 3.0 * (true > 10.0)) == pytest.approx(true, abs=1e-3)


def test_an_npz_of_another_shape(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz", t_device_s=np.arange(3.0))
    with pytest.raises(convert.NotConverted, match=r"\(3,\) stamps for ranges of shape"):
        convert.read(tmp_path / "a.npz")
    np.savez(tmp_path / "b.npz", range_mm=np.zeros((3, 4)))
    with pytest.raises(convert.NotConverted, match="t_device_s"):
        convert.read(tmp_path / "b.npz")


def test_an_output_that_cannot_be_written(tmp_path: Path, refused: Command) -> None:
    write_dat(tmp_path / "a.dat", 3)
    assert "No such file" in refused("convert", str(tmp_path / "a.dat"), str(tmp_path / "none" / "b.log"))


def test_the_real_rover_logs(log_root: Path, tmp_path: Path) -> None:
    periods = []
    for name, count, way in (("exp1", 756, 46.0), ("exp2", 641, 44.5)):
        source = log_root / "urg04lx" / f"{name}.dat.gz"
        scans = convert.even_stamps(convert.read(source), convert.DELAY_S)
        assert scans.ranges.shape == (count, 682)
        assert np.hypot(*np.diff(scans.poses[:, :2], axis=0).T).sum() == pytest.approx(way, abs=0.1)
        periods.append(scans.laser.period)
        assert parser.main(["convert", str(source), str(tmp_path / "a.log"), "--all"]) == 0
        log = read_carmen(tmp_path / "a.log")
        logged = convert.read(source).ranges
        assert np.array_equal([s.ranges for s in scans_of(log)], np.where((logged >= 20) & (logged <= 5600), logged, 0))
        assert not log.report.notes
        assert not log.report.skipped
    assert periods[0] == pytest.approx(periods[1], rel=2e-4)  # the same sensor on both days


def test_the_real_utm_log(log_root: Path, tmp_path: Path) -> None:
    assert parser.main(["convert", str(log_root / "utm30lx" / "scans.npz"), str(tmp_path / "a.log.gz")]) == 0
    log = read_carmen(tmp_path / "a.log.gz")
    assert len(log.stamps) == 885
    with np.load(log_root / "utm30lx" / "scans.npz") as data:
        logged = data["range_mm"].astype(np.int64)
    assert np.array_equal([scan.ranges for scan in scans_of(log)], np.where(logged >= 23, logged, 0))
