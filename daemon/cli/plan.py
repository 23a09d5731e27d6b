"""`lumiloop plan MAP`: selects lamps for a floor, prints their effect, writes them as a survey, and plots them."""

from __future__ import annotations

import argparse
import contextlib
import math
import sys
from pathlib import Path
from typing import Final

import numpy as np

from daemon.cli.reports.output import print_report
from daemon.cli.reports.plan import as_object
from daemon.commissioning import plan_plot
from daemon.commissioning.floor import Array, Hall, NoHall, read_hall
from daemon.commissioning.lamp_selection import Goals, Plan, choose, codes_for, plan_of
from daemon.commissioning.laser_information import KNOWN_SIGMA_M, wall_information
from daemon.commissioning.light_information import Fitting
from daemon.commissioning.reach import Robot
from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError, dump, read_survey
from daemon.config.survey_schema import last_code
from daemon.devices.photodiode import profile_of
from daemon.replay.results import Folder, OutputRefused
from daemon.system import console
from daemon.system.extras import how_to_install
from estimator import Lamp, Receiver, Survey

HEADROOM_M: Final = 0.2
HIGHEST_M: Final = 30.0
WIDEST_M: Final = 10.0
OPEN_M: Final = 1.0
"""An axis with a larger sigma, m, counts as unknown."""


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    if wrong := _wrong(args):
        return console.fail(wrong, console.USAGE)
    try:
        survey = _hung(args)
        receiver = survey.receiver if survey is not None else _receiver(args.settings)
        height = args.height if survey is None else float(np.median([lamp.z for lamp in survey.lamps]))
        fitting = fitting_of(receiver, height)
        hall = read_hall(args.map, args.spacing, Robot(args.width, args.start and tuple(args.start)))
        walls = wall_information(hall, args.reach)
        goals = Goals(args.links, args.accuracy, 0.01 * args.share, exact=args.lamps)
        plan = choose(hall, fitting, walls, goals) if survey is None else plan_of(
            hall, fitting, walls, goals, hall.in_plan(np.array([(lamp.x, lamp.y) for lamp in survey.lamps]))
        )  # fmt: skip
        if args.json:
            with contextlib.redirect_stdout(sys.stderr):
                _write(args, hall, plan, receiver, survey is None)
            print_report("plan", as_object(hall, plan, goals, fitting, args.out))
        else:
            sys.stdout.write(report(hall, plan, goals, fitting))
            _write(args, hall, plan, receiver, survey is None)
        if survey is None and (short := plan.short_of(goals)):
            return console.fail(
                f"{short}: plan parts of the hall separately, or lower the goals (--share, --links, --accuracy)"
            )
    except (NoHall, SurveyError, OutputRefused, ValueError) as error:
        return console.fail(str(error))
    return console.OK


def _wrong(args: argparse.Namespace) -> str:
    if not HEADROOM_M < args.height <= HIGHEST_M:
        return (
            f"--height {args.height:g}: out of range; give metres above the ground, more than {HEADROOM_M:g}, "
            f"{HIGHEST_M:g} at most"
        )
    metres = args.accuracy, args.reach, args.spacing
    if not (all(0.0 < m < math.inf for m in metres) and 0.0 < args.share <= 100.0 and args.links >= 1):
        return "--accuracy, --reach, --spacing, --links must be above 0 and finite, and --share above 0 and at most 100"
    if not 0.0 < args.width <= WIDEST_M:
        return f"--width {args.width:g}: out of range; give metres above 0, {WIDEST_M:g} at most"
    if args.start is not None and not all(math.isfinite(m) for m in args.start):
        return "--start: give two finite numbers, metres in the map frame"
    if args.lamps is not None and args.survey is not None:
        return "--lamps plans new lamps, and --survey assesses installed ones; use only one of them"
    if args.lamps is not None and args.lamps < 1:
        return "--lamps: give a number of 1 or more"
    return ""


def _hung(args: argparse.Namespace) -> Survey | None:
    """Returns the lamps to be judged; None: lamps are to be selected."""
    if args.survey is None:
        return None
    survey = read_survey(args.survey, profile_of(args.settings.photodiode))
    if not survey.lamps:
        raise NoHall(f"{args.survey}: the survey has no lamps")
    return survey


def _receiver(settings: Config) -> Receiver:
    if not settings.lights.survey:
        return Receiver()
    return read_survey(Path(settings.lights.survey), profile_of(settings.photodiode)).receiver


def fitting_of(receiver: Receiver, height: float) -> Fitting:
    """Returns the parameters of lamps ``height`` m above the ground with this receiver.

    Raises:
        NoHall: the lamps would not be above the receiver.
    """
    if height - receiver.z < HEADROOM_M:
        raise NoHall(f"lamps at {height:g} m are not above the receiver at {receiver.z:g} m; correct --height")
    return Fitting(height - receiver.z, Lamp(0, 0, 0.0, 0.0, 0.0).order + receiver.order, receiver.half_fov_rad)


def report(hall: Hall, plan: Plan, goals: Goals, fitting: Fitting) -> str:
    """Returns the results as text."""
    area = len(hall.places) * hall.step**2
    blind = wall_sigma(plan) > KNOWN_SIGMA_M
    still = plan.sigma > KNOWN_SIGMA_M
    counts = np.bincount(np.minimum(plan.links, goals.links), minlength=goals.links + 1)
    fewer = ", ".join(f"{count} see {number}" for number, count in enumerate(counts[:-1]) if count)
    lines = [
        f"accessible area: {area:.0f} m2, {len(hall.places)} positions {hall.step:.2f} m apart",
        *hall.reached.lines(hall.pictured),
        f"lidar solution: a degenerate direction (sigma over {100 * KNOWN_SIGMA_M:.0f} cm) at "
        f"{_percent(blind)} of the positions",
        f"lamps: {len(plan.lamps)}, one for every {area / max(1, len(plan.lamps)):.1f} m2; each reaches "
        f"{fitting.reach:.1f} m",
        f"links: {_percent(plan.links >= goals.links)} of positions see {goals.links} or more"
        + (f"; of {len(plan.links)}, {fewer}" if fewer else ""),
        f"light solution: {deviations(plan.light_sigma)}",
        f"lidar and light: {deviations(plan.sigma)}; a degenerate direction remains at {_percent(still)}",
    ]
    if not plan.possible.all():
        never = "cannot reach the goals with any lamps: they are corners or narrow, or the lamps are too low"
        lines.append(f"{_percent(~plan.possible)} of the positions {never}")
    if goals.exact is None:
        share = 100.0 * float(plan.reached)
        lines.append(
            f"{goals.links} links and {100 * goals.accuracy:.0f} cm by the light solution: {share:.1f} % of positions"
        )
    return "".join(f"{line}\n" for line in lines)


def wall_sigma(plan: Plan) -> Array:
    """(n,) sigma of the worse axis by the lidar alone, m."""
    from daemon.commissioning.light_information import worst

    return worst(plan.walls)[0]


def _percent(which: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> str:
    return f"{100.0 * float(which.mean()):.1f} %"


def deviations(sigma: Array) -> str:
    """Returns a text on sigmas (n,), m, of the worse axis; above :data:`OPEN_M` no length is given."""
    median, most = _quantiles(sigma)
    middle = f"median {100.0 * median:.1f} cm" if median <= OPEN_M else f"median over {OPEN_M:g} m"
    if most <= OPEN_M:
        return f"{middle}, 95 % within {100.0 * most:.1f} cm"
    return f"{middle}, over {OPEN_M:g} m at {_percent(sigma > OPEN_M)} of positions"


def _quantiles(sigma: Array) -> tuple[float, float]:
    ordered = np.sort(sigma)
    return float(ordered[len(ordered) // 2]), float(ordered[min(len(ordered) - 1, int(0.95 * len(ordered)))])


def _write(args: argparse.Namespace, hall: Hall, plan: Plan, receiver: Receiver, chosen: bool) -> None:
    folder = Folder(args.out)
    if chosen:
        profile = profile_of(args.settings.photodiode)
        codes, apart = codes_for(plan.lamps, last_code(profile) + 1)
        xy = hall.in_map(plan.lamps)
        lamps = tuple(
            Lamp(number, code, round(float(x), 3), round(float(y), 3), args.height, sigma_ln=0.05)
            for number, (code, (x, y)) in enumerate(zip(codes, xy, strict=True), 1)
        )
        notes = [
            f"Planned for {args.map.name}. These are planned positions; survey the lamps after they are installed."
        ]
        folder.write("lights.toml", dump(Survey(lamps, receiver, depth=profile.depth), notes).encode())
        sys.stdout.write(f"{folder.path / 'lights.toml'}: the lamps with their codes\n")
        if math.isfinite(apart):
            sys.stdout.write(f"codes are reused, {apart:.1f} m or more apart\n")
    if (drawn := plan_plot.draw(hall, plan)) is None:
        console.say(f"plots need matplotlib: {how_to_install('plot')}")
    else:
        folder.write("plan.png", drawn)
        sys.stdout.write(f"{folder.path / 'plan.png'}: links, accuracy, degenerate directions\n")
