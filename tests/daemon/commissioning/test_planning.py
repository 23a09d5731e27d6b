"""Planning lamps: what is predicted against what the estimator's own model and solver do, and plans against rivals."""

import io
import json
import math
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from daemon.cli import parser
from daemon.cli.plan import deviations, report
from daemon.commissioning.floor import Hall, NoHall, clear, hall_of, read_hall
from daemon.commissioning.lamp_selection import Goals, Plan, choose, codes_for, plan_of
from daemon.commissioning.laser_information import KNOWN_SIGMA_M, wall_information
from daemon.commissioning.light_information import Fitting, information, seen_from, told, worst
from daemon.commissioning.plan_plot import draw
from daemon.config.survey_loader import read_survey
from daemon.system import console
from estimator.light_filter.lambertian import Wrt, expected
from estimator.light_filter.survey import Lamp, Receiver, Survey
from estimator.paper.lateration import locate
from estimator.paper.lateration_model import Doubt, Received, SolverSettings
from tests.commands import Command

Cells = npt.NDArray[np.int8]
FITTING = Fitting(2.2)
RNG = np.random.default_rng(5)


def room(width: float, depth: float, resolution: float = 0.05) -> Cells:
    """A closed room with nothing known around it."""
    rows, columns = round(depth / resolution), round(width / resolution)
    cells = np.full((rows + 8, columns + 8), -1, np.int8)
    cells[2:-2, 2:-2] = 1
    cells[4:-4, 4:-4] = 0
    return cells


def hall(width: float = 8.0, depth: float = 6.0, spacing: float = 0.5) -> Hall:
    return hall_of(room(width, depth), 0.05, (0.0, 0.0, 0.0), spacing)


def test_what_a_place_learns_is_the_models_own_derivative() -> None:
    lamps = (Lamp(1, 1, 0.0, 0.0, 2.5), Lamp(2, 2, 1.5, 0.5, 2.5), Lamp(3, 3, -1.0, 2.0, 2.5))
    survey = Survey(lamps, floor=0.0)
    for place in RNG.uniform(-1.0, 1.0, (10, 2)):
        model = expected(lamps, survey, np.array((*place, 0.3)))
        for lamp, J in zip(lamps, model.jacobian, strict=True):
            (row,) = told(FITTING, (place - (lamp.x, lamp.y))[None])
            gradient = row[3:5] / row[5]
            np.testing.assert_allclose(gradient, J[[Wrt.X, Wrt.Y]], rtol=1e-6, atol=1e-9)
            np.testing.assert_allclose(row[0] * row[5], row[3] ** 2, rtol=1e-9)


def test_a_gain_that_all_links_share_is_taken_out() -> None:
    off = RNG.uniform(-2.0, 2.0, (5, 2))
    rows = told(FITTING, off)
    G, variance = rows[:, 3:5] / rows[:, 5:], 1.0 / rows[:, 5]
    C = np.diag(variance) + 0.05**2
    whole = G.T @ np.linalg.inv(C) @ G
    ((xx, xy, yy),) = information(rows.sum(axis=0)[None])
    np.testing.assert_allclose((xx, xy, yy), (whole[0, 0], whole[0, 1], whole[1, 1]), rtol=1e-9)


def test_predicted_deviations_are_those_of_the_estimators_solver() -> None:
    """100 draws of everything that is not known, at each of six places under twelve lamps."""
    lamps = tuple(
        Lamp(n, n, 1.0 + 1.8 * (n % 4), 1.0 + 1.9 * (n // 4), 2.5, sigma_ln=FITTING.sigma_ln) for n in range(12)
    )
    survey = Survey(lamps, Receiver(), floor=0.0)
    ratios = []
    for x, y in RNG.uniform((2.0, 2.0), (5.4, 3.8), (6, 2)):
        model = expected(lamps, survey, np.array((x, y, 0.0)))
        near = [i for i, lamp in enumerate(lamps) if math.hypot(lamp.x - x, lamp.y - y) < FITTING.reach]
        off = np.array([(x - lamps[i].x, y - lamps[i].y) for i in near])
        rows = told(FITTING, off)
        (predicted,), _ = worst(information(rows.sum(axis=0)[None]))
        error = []
        for _ in range(100):
            ln = 0.05 * RNG.normal() + RNG.normal(size=len(near)) / np.sqrt(rows[:, 5])
            amplitude = model.amplitude[near] * np.exp(ln)
            received = Received(tuple(lamps[i] for i in near), amplitude, np.full(len(near), 1e-24))
            found = locate(received, survey, SolverSettings(link_n=None, rim=0.0, doubt=Doubt(floor=0.0)))
            place = min(found.places, key=lambda p: math.hypot(*(p.xy - (x, y))))
            error.append(place.xy - (x, y))
        axis = math.sqrt(max(np.linalg.eigvalsh(np.cov(np.array(error).T))))
        ratios.append(axis / predicted)
    assert 0.75 < float(np.median(ratios)) < 1.35, ratios
    assert max(ratios) < 1.8, ratios


def test_a_corridor_is_blind_along_itself_until_lamps_hang_there() -> None:
    long = hall(30.0, 2.0)
    walls = wall_information(long, 8.0)
    middle = np.abs(long.places[:, 0] - 15.0) < 5.0
    sigma, way = worst(walls)
    assert (sigma[middle] > KNOWN_SIGMA_M).all()
    assert np.abs(np.sin(way[middle])).max() < 0.1, "along x"
    ends = (long.places[:, 0] < 4.0) | (long.places[:, 0] > 26.0)
    assert (sigma[ends] < KNOWN_SIGMA_M).mean() > 0.9
    plan = choose(long, FITTING, walls, Goals())
    assert (plan.sigma[middle] < KNOWN_SIGMA_M).mean() > 0.95


def test_links_are_those_that_can_be_seen() -> None:
    cells = room(8.0, 6.0)
    cells[4:100, 80:84] = 1  # a wall with a gap
    cells[60:66, 40:46] = 1  # a table
    split = hall_of(cells, 0.05, (0.0, 0.0, 0.0), 1.0)
    plan = choose(split, FITTING, wall_information(split), Goals(exact=6))
    assert len(plan.lamps) == 6
    counted = np.zeros(len(split.places), np.int64)
    for lamp in plan.lamps:
        for index, place in enumerate(split.places):
            if math.hypot(*(place - lamp)) < FITTING.reach:
                counted[index] += all(
                    not split.tall[int(y / split.cell), int(x / split.cell)]
                    for x, y in lamp + np.linspace(0.0, 1.0, 200)[:, None] * (place - lamp)
                )
    assert (plan.links == counted).mean() > 0.995  # ways that graze a corner are a matter of taste
    table = np.array((2.15, 3.15))
    assert clear(split.tall, split.cell, table - (1.0, 0.0), table[None] + (1.0, 0.0)).all(), "light passes over it"
    assert split.solid[31, 21]
    beyond = np.array((5.5, 1.5))
    assert not clear(split.tall, split.cell, np.array((3.0, 1.5)), beyond[None]).any(), "but not through a wall"


@pytest.fixture(scope="module")
def planned() -> tuple[Hall, Plan]:
    large = hall(10.0, 7.0)
    return large, choose(large, FITTING, wall_information(large), Goals())


def test_the_goals_are_reached_with_no_lamp_too_many(planned: tuple[Hall, Plan]) -> None:
    large, plan = planned
    met = (plan.links >= 4) & (plan.light_sigma <= 0.10)
    assert met[plan.possible].mean() >= 0.95
    walls = wall_information(large)
    for left_out in range(len(plan.lamps)):
        fewer = plan_of(large, FITTING, walls, Goals(), np.delete(plan.lamps, left_out, axis=0))
        still = (fewer.links >= 4) & (fewer.light_sigma <= 0.10)
        assert still[plan.possible].mean() < 0.95


def test_a_plan_that_falls_short_says_why(
    planned: tuple[Hall, Plan], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    large, plan = planned
    assert plan.short_of(Goals()) == ""
    few = Goals(most=3)
    short = choose(large, FITTING, wall_information(large), few).short_of(few)
    assert re.fullmatch(r"goal NOT reached \(limit of 3 lamps\); \d+\.\d % of the positions that can reach it", short)
    path = write_pgm(tmp_path, room(3.0, 3.0))
    words = ["plan", str(path), "--out", str(tmp_path / "plan"), "--lamps", "400", "--spacing", "1.0"]
    assert parser.main(words) == console.FAILED
    said = capsys.readouterr()
    assert re.search(r"only \d+ positions", said.err)
    assert "lamps: " in said.out, "what was found is told and written"
    assert (tmp_path / "plan" / "lights.toml").exists()


def test_a_plan_is_better_than_as_many_lamps_in_rows(planned: tuple[Hall, Plan]) -> None:
    large, plan = planned
    walls = wall_information(large)
    best = 0.0
    for across in range(2, len(plan.lamps) + 1):
        along = len(plan.lamps) // across
        if along < 2:
            continue
        x, y = np.meshgrid((np.arange(across) + 0.5) / across * 10.0, (np.arange(along) + 0.5) / along * 7.0)
        rows = plan_of(large, FITTING, walls, Goals(), np.column_stack((x.ravel(), y.ravel())) + 0.2)
        best = max(best, rows.reached)
    assert plan.reached > best


def test_codes_are_used_again_where_they_are_far_apart() -> None:
    lamps = np.column_stack((np.arange(10.0), np.zeros(10)))
    codes, apart = codes_for(lamps, 4)
    assert codes[:4] == [0, 1, 2, 3]
    again = [abs(i - j) for i in range(10) for j in range(i) if codes[i] == codes[j]]
    assert min(again) == apart >= 3.0
    assert codes_for(lamps, 10) == (list(range(10)), math.inf)


def write_pgm(folder: Path, cells: Cells, origin: str = "[1.0, -2.0, 0.0]") -> Path:
    grey = np.where(cells == 1, 0, np.where(cells == 0, 254, 205)).astype(np.uint8)[::-1]
    (folder / "map.pgm").write_bytes(f"P5\n{grey.shape[1]} {grey.shape[0]}\n255\n".encode() + grey.tobytes())
    text = f"image: map.pgm\nresolution: 0.05\norigin: {origin}\nnegate: 0\noccupied_thresh: 0.65\nfree_thresh: 0.196\n"
    (folder / "map.yaml").write_text(text)
    return folder / "map.pgm"


def test_the_command_writes_a_survey_that_it_can_judge_again(tmp_path: Path, done: Command) -> None:
    path = write_pgm(tmp_path, room(6.0, 5.0))
    words = ["plan", str(path), "--out", str(tmp_path / "plan"), "--height", "3.0", "--lamps", "9", "--spacing", "0.8"]
    said = done(*words)
    assert "lamps: 9, one for every" in said
    survey = read_survey(tmp_path / "plan" / "lights.toml")
    assert len({lamp.code for lamp in survey.lamps}) == 9
    assert {lamp.z for lamp in survey.lamps} == {3.0}
    assert all(1.0 < lamp.x < 7.6 and -2.0 < lamp.y < 3.6 for lamp in survey.lamps), "in the map frame"
    assert (tmp_path / "plan" / "plan.png").read_bytes().startswith(b"\x89PNG")
    judged = ["plan", str(path), "--out", str(tmp_path / "b"), "--survey", str(tmp_path / "plan" / "lights.toml")]
    again = done(*judged)
    assert [line for line in said.splitlines() if line.startswith("lidar and light")] == [
        line for line in again.splitlines() if line.startswith("lidar and light")
    ]
    assert not (tmp_path / "b" / "lights.toml").exists()
    told = json.loads(done(*judged, "--json"))
    assert (told["schema"], told["lamps"]["count"]) == ("lumiloop.plan/1", 9)
    places = {(lamp.x, lamp.y) for lamp in survey.lamps}
    assert {(at["x_m"], at["y_m"]) for at in told["lamps"]["positions"]} == places
    median = 100.0 * told["accuracy"]["laser_and_light"]["median_m"]
    assert f"lidar and light: median {median:.1f} cm" in again


@pytest.mark.parametrize(("width", "depth"), [(40.0, 2.2), (2.2, 30.0)])
def test_the_picture_of_a_long_floor_is_not_mostly_paper(width: float, depth: float) -> None:
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    floor = hall(width, depth)
    along = np.linspace(1.0, max(width, depth) - 1.0, 8)
    lamps = np.column_stack((along, np.full(8, 1.2)))
    plan = plan_of(floor, FITTING, wall_information(floor), Goals(), lamps if width > depth else lamps[:, ::-1])
    drawn = draw(floor, plan)
    assert drawn is not None
    pixels = imread(io.BytesIO(drawn))
    paper = np.mean(np.all(pixels[:, :, :3] == 1.0, axis=2))
    assert paper < 0.85
    for edge in (pixels[0], pixels[-1], pixels[:, 0], pixels[:, -1]):
        assert np.all(edge[:, :3] == 1.0)  # nothing is cut off


def test_places_of_the_picture_lie_side_by_side() -> None:
    """No line of paper runs through the floor: no white pixel has floor on both sides of it."""
    pytest.importorskip("matplotlib")
    from matplotlib.image import imread

    floor = hall(23.0, 17.0)
    x, y = np.meshgrid(np.linspace(2.0, 21.0, 5), np.linspace(2.0, 15.0, 4))
    plan = plan_of(floor, FITTING, wall_information(floor), Goals(), np.column_stack((x.ravel(), y.ravel())))
    drawn = draw(floor, plan)
    assert drawn is not None
    pixels = imread(io.BytesIO(drawn))[:, :, :3]
    pixels = pixels[:, : 2 * pixels.shape[1] // 3]  # links and accuracy
    coloured = np.ptp(pixels, axis=2) > 0.15
    white = pixels.min(axis=2) > 0.97
    assert coloured.mean() > 0.2
    for a, b, between in (
        (coloured[:, :-4], coloured[:, 4:], white[:, 2:-2]),
        (coloured[:-4], coloured[4:], white[2:-2]),
    ):
        assert np.sum(a & b & between) == 0


def test_a_plan_that_lies_turned_in_the_map() -> None:
    turned = hall_of(room(6.0, 5.0), 0.05, (1.0, 2.0, math.pi / 2), 1.0)
    ((x, y),) = turned.in_map(np.array(((2.0, 1.0),)))
    assert (x, y) == pytest.approx((0.0, 4.0))


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--height", "0.4"], "not above the receiver"),
        (["--height", "99"], "give metres above the ground, more than 0.2, 30 at most"),
        (["--lamps", "0"], "give a number of 1 or more"),
        (["--lamps", "3", "--survey", "none.toml"], "use only one of them"),
        (["--accuracy", "0"], "must be above 0"),
        (["--reach", "nan"], "must be above 0"),
        (["--spacing", "inf"], "must be above 0"),
        (["--survey", "none.toml"], "none.toml"),
        (["--width", "0"], "--width 0: out of range; give metres above 0"),
        (["--start", "nan", "0"], "two finite numbers"),
        (["--start", "-90", "0"], "the robot does not fit there; the nearest possible position is"),
    ],
)
def test_what_cannot_be_planned_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], text: str
) -> None:
    path = write_pgm(tmp_path, room(4.0, 3.0))
    assert parser.main(["plan", str(path), "--out", str(tmp_path / "p"), *words]) != console.OK
    assert text in capsys.readouterr().err


def test_plans_that_are_none(tmp_path: Path) -> None:
    for name in ("none.yaml", "none.pgm"):
        with pytest.raises(NoHall, match=rf"{name}: no such file"):
            read_hall(tmp_path / name, 0.5)
    with pytest.raises(NoHall, match="this is a folder; name the image in it"):
        read_hall(tmp_path, 0.5)
    (tmp_path / "alone.pgm").touch()
    with pytest.raises(NoHall, match="with the size of a pixel is missing"):
        read_hall(tmp_path / "alone.pgm", 0.5)
    with pytest.raises(NoHall, match="the plan has no free position for a robot"):
        hall_of(np.ones((50, 50), np.int8), 0.05, (0.0, 0.0, 0.0), 0.5)
    (tmp_path / "bad.lumimap").write_bytes(b"no map")
    with pytest.raises(NoHall):
        read_hall(tmp_path / "bad.lumimap", 0.5)


def test_a_lamp_in_a_corner_tells_only_those_within_reach() -> None:
    small = hall()
    seen = seen_from(small, FITTING, np.array((0.5, 0.5)))
    far = np.hypot(*(small.places[seen.places] - 0.5).T)
    assert 0 < len(far) < len(small.places)
    assert far.max() < FITTING.reach
    text = report(
        small, plan_of(small, FITTING, wall_information(small), Goals(), np.array(((0.5, 0.5),))), Goals(), FITTING
    )
    assert "light solution: median over 1 m, over 1 m at 100.0 % of positions" in text
    some = np.array((0.05, 0.06, math.inf, 0.07, 0.08, 0.09, 0.04, 0.05, 0.06, math.inf))
    assert deviations(some) == "median 7.0 cm, over 1 m at 20.0 % of positions"
    assert deviations(some[:2]) == "median 6.0 cm, 95 % within 6.0 cm"
