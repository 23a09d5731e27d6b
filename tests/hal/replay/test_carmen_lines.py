"""The line format: fields, optional parts, and what is refused."""

import math

import pytest

from hal.replay.carmen_lines import LaserLine, LineProblem, OdometryLine, ParameterLine, parse

FLASER = b"FLASER 3 1.00 2.50 81.83 1.1 2.0 0.5 1.0 2.0 0.5 976052857.337530 host 0.25"
CONFIG = b"4 -1.570796 3.141593 0.017453 81.92 0.01 0 3 1.00 2.50 81.83"
POSES = b"1.1 2.0 0.5 1.0 2.0 0.5"


def laser(line: bytes) -> LaserLine:
    record = parse(line)
    assert isinstance(record, LaserLine)
    return record


def test_flaser_has_the_laser_first_and_the_robot_second() -> None:
    line = laser(FLASER)
    assert line.ranges.tolist() == [1.0, 2.5, 81.83]
    assert line.laser == (1.1, 2.0, 0.5)
    assert line.robot == (1.0, 2.0, 0.5)
    assert line.stamp == 976052857.337530
    assert line.setup.count == 3
    assert math.isnan(line.setup.start)


@pytest.mark.parametrize(
    ("remissions", "safety", "expected"),
    [
        (b"", b"0.1 0.0 0.2 0.1", []),  # as the logger's own header describes it
        (b"", b"0.1 0.0 0.2 0.1 1e9", []),
        (b"0", b"0.1 0.0 0.2 0.1", []),  # as many fields as the line above: told apart by the missing decimal point
        (b"0", b"0.1 0.0 0.2 0.1 1e9", []),
        (b"3 7 8 9", b"0.1 0.0 0.2 0.1 1e9", [7.0, 8.0, 9.0]),
        (b"2 7 8", b"0.1 0.0 0.2 0.1 1e9", []),  # not one per beam: of no use
    ],
)
def test_robotlaser_with_and_without_remissions(remissions: bytes, safety: bytes, expected: list[float]) -> None:
    line = laser(b" ".join([b"ROBOTLASER1", CONFIG, remissions, POSES, safety, b"12.5 host 12.6"]))
    assert line.setup.maximum == 81.92
    assert line.setup.resolution == 0.017453
    assert (line.laser, line.robot) == ((1.1, 2.0, 0.5), (1.0, 2.0, 0.5))
    assert line.remission.tolist() == expected
    assert line.stamp == 12.5


def test_rawlaser_has_no_poses() -> None:
    line = laser(b"RAWLASER1 " + CONFIG + b" 0 12.5 host 12.6")
    assert line.laser is None
    assert line.robot is None
    assert line.ranges.tolist() == [1.0, 2.5, 81.83]
    assert laser(b"RAWLASER1 " + CONFIG + b" 12.5 host 12.6") == line


def test_odometry_and_parameters() -> None:
    assert parse(b"ODOM 1.0 2.0 0.5 0.1 0.2 0.0 12.5 host 12.6") == OdometryLine((1.0, 2.0, 0.5), 12.5)
    offset = ParameterLine("robot_frontlaser_offset", "0.145")
    assert parse(b"PARAM robot_frontlaser_offset 0.145 12.5 host 12.6") == offset
    assert parse(b"PARAM robot_frontlaser_offset 0.145") == offset
    assert parse(b"PARAM empty") == ParameterLine("empty", "")


@pytest.mark.parametrize("line", [b"", b"   ", b"# FLASER 3", b"SYNC start 1 host 2", b"TRUEPOS 1 2 3 4 5 6 7 h 8"])
def test_lines_without_use(line: bytes) -> None:
    assert parse(line) is None


@pytest.mark.parametrize(
    ("line", "says"),
    [
        (FLASER[:-12], "fields instead of"),
        (FLASER.replace(b"2.50", b"2.5x"), "could not convert"),
        (FLASER.replace(b"FLASER 3", b"FLASER 0"), "0 beams"),
        (FLASER.replace(b"FLASER 3", b"FLASER -3"), "-3 beams"),
        (FLASER.replace(b"FLASER 3", b"FLASER 999999"), "999999 beams"),
        (FLASER.replace(b"976052857.337530", b"nan"), "time stamp"),
        (FLASER + b" " + FLASER, "fields instead of"),  # two lines run together
        (b"FLASER", "missing"),
        (b"ODOM 1 2 3", "fields instead of"),
        (b"ODOM nan 2 3 0 0 0 1 h 1", "not a number"),
        (b"PARAM", "missing"),
        (b"ROBOTLASER1 4 -1.5 3.1", "missing"),
        (b"<html><body>404</body></html>", "unknown kind"),
    ],
)
def test_refused_with_the_reason(line: bytes, says: str) -> None:
    with pytest.raises(LineProblem, match=says):
        parse(line)


def test_a_pose_that_is_no_number_does_not_cost_the_scan() -> None:
    line = laser(FLASER.replace(b" 1.0 2.0 0.5 976", b" nan 2.0 0.5 976"))
    assert line.robot is None
    assert line.laser is not None
