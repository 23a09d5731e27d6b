"""Floor that a robot reaches, and a survey from a recorded drive."""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from daemon.cli import parser
from daemon.cli.plan import report
from daemon.commissioning.floor import Hall, NoHall, hall_of
from daemon.commissioning.lamp_selection import Goals, Plan, plan_of
from daemon.commissioning.laser_information import wall_information
from daemon.commissioning.light_information import Fitting
from daemon.commissioning.plan_plot import figure
from daemon.commissioning.reach import Drive, Robot
from daemon.config.loader import load
from daemon.config.survey_loader import read_survey
from daemon.system import console
from tests.daemon.commissioning.recorded_drive import record
from tools.sim.light_harness import BUS

FITTING = Fitting(2.2)
ORIGIN = (40.0, -7.0, 0.6)


def in_map(x: float, y: float) -> tuple[float, float]:
    """Where a point of the plan lies in the map."""
    c, s = math.cos(ORIGIN[2]), math.sin(ORIGIN[2])
    return ORIGIN[0] + c * x - s * y, ORIGIN[1] + s * x + c * y


def rooms(door: float) -> npt.NDArray[np.int8]:
    """A room of 6 m x 4 m, one of 4 m x 4 m beside it, and a door of that width between them."""
    cells = np.full((90, 220), -1, np.int8)
    cells[4:86, 6:214] = 1
    cells[5:85, 7:127] = 0
    cells[5:85, 131:211] = 0
    half = round(0.5 * door / 0.05)
    cells[45 - half : 45 + half, 127:131] = 0
    return cells


def halls(door: float, robot: Robot, drive: Drive | None = None) -> Hall:
    return hall_of(rooms(door), 0.05, ORIGIN, 0.5, robot, drive)


def said(hall: Hall) -> str:
    plan = plan_of(hall, FITTING, wall_information(hall), Goals(), np.array(((3.0, 2.0),)))
    return report(hall, plan, Goals(), FITTING)


def test_a_robot_reaches_what_it_fits_through() -> None:
    start = in_map(2.0, 2.0)
    wide, narrow = halls(1.0, Robot(0.6, start)), halls(1.0, Robot(1.2, start))
    assert wide.places[:, 0].max() > 9.5
    assert "left out" not in said(wide)
    assert narrow.places[:, 0].max() < 6.4
    assert narrow.spots[:, 0].max() < 7.0, "no lamp where it does not drive"
    assert f"excluded: 8 m2 that a robot 1.20 m wide cannot reach from ({start[0]:g}, {start[1]:g})" in said(narrow)
    other = halls(1.0, Robot(1.2, in_map(8.0, 2.0)))
    assert other.places[:, 0].min() > 6.4


def test_areas_that_are_not_connected_are_named() -> None:
    apart = halls(0.4, Robot())
    assert apart.places[:, 0].max() > 9.5, "no start is known: all of it"
    assert "2 areas are not connected; give --start X Y" in said(apart)
    with pytest.raises(
        NoHall, match=r"--start 40 -20: the robot does not fit there; the nearest possible position is \d+\.\d\d -"
    ):
        halls(0.4, Robot(0.6, (40.0, -20.0)))


def driven(echoes: int) -> Drive:
    """Scans from the larger room, some of them with beams that came back from the whole door."""
    pane = np.array([in_map(6.45, y) for y in np.arange(1.6, 3.0, 0.1)])
    path = np.array([in_map(x, 2.0) for x in (1.0, 2.0, 3.0, 4.0)])
    return Drive(path, [pane] * echoes + [np.zeros((0, 2))] * (4 - echoes))


def test_floor_behind_glass_is_left_out_and_named() -> None:
    """A door of glass: free in the map, and beams of several scans came back from it."""
    open_door = halls(1.0, Robot(), driven(0))
    assert open_door.places[:, 0].max() > 9.5
    assert "left out" not in said(open_door)
    assert halls(1.0, Robot(), driven(1)).places[:, 0].max() > 9.5, "somebody may have walked there once"
    glass = halls(1.0, Robot(), driven(2))
    assert glass.places[:, 0].max() < 6.4
    assert "excluded: 12 m2 that the lidar measured only through glass" in said(glass)


def test_somebody_who_walks_about_is_no_glass() -> None:
    """Echoes in the middle of the room, from two scans: nothing behind them is left out, nor what they stand on."""
    person = np.array([in_map(x, y) for x in np.arange(2.0, 2.6, 0.1) for y in np.arange(1.0, 1.6, 0.1)])
    path = driven(2)
    crowded = halls(1.0, Robot(), Drive(path.path, [*path.echoes, person, person]))
    assert len(crowded.places) == len(halls(1.0, Robot(), path).places)
    alone = halls(1.0, Robot(), Drive(path.path, [person, person]))
    assert len(alone.places) == len(halls(1.0, Robot(), driven(0)).places)


def test_a_map_file_leaves_out_where_nobody_has_driven() -> None:
    hall = halls(0.4, Robot(), driven(0))
    assert hall.places[:, 0].max() < 6.4
    assert "cannot reach from its recorded path" in said(hall)


@pytest.fixture(scope="module")
def drawn() -> tuple[Hall, Plan]:
    hall = halls(1.0, Robot())
    return hall, plan_of(hall, FITTING, wall_information(hall), Goals(), np.array(((2.0, 1.0), (4.0, 3.0), (8.5, 2.5))))


def test_a_lamp_is_drawn_at_its_place_in_the_map(drawn: tuple[Hall, Plan]) -> None:
    """By the axes' own labels, from the pixels: a white disc in a black ring on colour, a black wall, and paper."""
    pytest.importorskip("matplotlib")
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    plot = figure(*drawn)
    canvas = FigureCanvasAgg(plot)
    canvas.draw()
    pixels = np.asarray(canvas.buffer_rgba())[::-1, :, :3].astype(float)  # rows from below, as axes count
    for axes in plot.axes[:2]:
        assert axes.get_xlabel() == "x, m (map frame)"

        def around(x: float, y: float, axes: object = axes, size: int = 12) -> npt.NDArray[np.float64]:
            column, row = (round(float(p)) for p in axes.transData.transform(in_map(x, y)))  # type: ignore[attr-defined]
            return np.asarray(pixels[row - size : row + size + 1, column - size : column + size + 1])

        for lamp in drawn[1].lamps:
            disc = around(*lamp)
            assert disc[10:15, 10:15].min() > 250, "white in the middle"
            assert disc.min() < 60, "in a black ring"
            assert np.ptp(disc[0, 0]) > 20, "on colour"
        assert around(0.32, 2.0, size=3).min() < 60, "the left wall"
        assert around(6.45, 4.3, size=3).min() < 60, "the wall between the rooms"
        assert around(1.0, 3.0, size=3).min() < 250, "floor"


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_recorded_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = record(tmp_path / "teach", 100.0)
    out = tmp_path / "lights.toml"
    assert parser.main(["survey", str(tmp_path / "teach"), "--height", "2.9", "--out", str(out)]) == console.OK
    assert scene.light is not None
    placed = {f.code: at for f, at in zip(scene.light.ceiling.fixtures, scene.light.ceiling.placed, strict=True)}
    start = scene.drive.pose(np.zeros(1))[0]
    c, s = np.cos(start[2]), np.sin(start[2])
    errors = []
    for lamp in read_survey(out).lamps:
        x, y = start[0] + c * lamp.x - s * lamp.y, start[1] + s * lamp.x + c * lamp.y
        if abs(x) < 5.0 and abs(y) < 5.0:
            errors.append(float(np.hypot(x - placed[lamp.code][0], y - placed[lamp.code][1])))
    assert len(errors) == 16
    assert np.median(errors) < 0.1
    capsys.readouterr()
    better = tmp_path / "better.toml"
    assert parser.main(["calibrate", str(tmp_path / "teach"), "--out", str(better)]) == console.OK
    said = capsys.readouterr().out
    assert "not determined by this drive" in said
    assert len(read_survey(better).lamps) == len(placed)
    wheels = ["--out", str(tmp_path / "robot.toml")]
    assert parser.main(["calibrate", str(tmp_path / "teach"), "--odometry", "--lidar-mount", *wheels]) == console.OK
    assert load(tmp_path / "robot.toml").photodiode.bus == BUS
