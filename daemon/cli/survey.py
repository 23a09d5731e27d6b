"""`lumiloop survey REC`: estimates a light survey from a recorded drive, in the frame of the drive's map."""

from __future__ import annotations

import argparse
import sys

from daemon.commissioning.fit_plot import draw_survey
from daemon.commissioning.teach_drive import heard, read_drive
from daemon.config.survey_loader import SurveyError, write_survey
from daemon.replay.recorded_inputs import Given
from daemon.system import console
from estimator.calibration import Surveyed, TooLittle, survey
from hal.errors import HalError


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    if args.out.exists() and not args.force:
        return console.fail(f"{args.out} exists already; name another file with --out, or replace it with --force")
    keys = tuple(override.partition("=")[0].strip() for override in args.set)
    try:
        drive = read_drive(args.source, args.settings, Given(args.config is not None, keys))
        for sentence in drive.warnings:
            console.say(sentence)
        found = survey(heard(drive), drive.survey.receiver, drive.survey.depth, args.height)
        sys.stdout.write(report(found, args.height))
        head = [
            f"Lamps located from the recording {drive.path.name}. The frame is that of its map: origin at the start "
            "pose, x ahead.",
            "Height: " + ("as given." if args.height else "from the drive." if found.height_told else "a default."),
        ]
        write_survey(args.out, found.found.survey, head, remarks(found), force=args.force)
        sys.stdout.write(f"written: {args.out}\n{draw_survey(found, args.out.with_suffix('.png'))}\n")
    except (HalError, SurveyError) as error:
        return console.fail(str(error))
    except (TooLittle, ValueError) as error:
        return console.fail(f"{args.log}: {error}")
    return console.OK


def report(found: Surveyed, height: float | None) -> str:
    """Returns the results as text."""
    lines = [
        f"{'lamp':>6} {'code':>5} {'x m':>8} {'y m':>8} {'z m':>6} {'sigma m':>8} {'power W':>8} {'nearest m':>10}"
    ]
    for lamp, sigma, near in zip(found.found.survey.lamps, found.sigma, found.nearest, strict=True):
        spread = float((sigma[0] ** 2 + sigma[1] ** 2) ** 0.5)
        place = f"{lamp.x:>8.3f} {lamp.y:>8.3f} {lamp.z:>6.2f}"
        lines.append(f"{lamp.lamp_id:>6} {lamp.code:>5} {place} {spread:>8.3f} {lamp.power_w:>8.3f} {near:>10.2f}")
    if height is None and not found.height_told:
        lines.append(
            "the drive does not determine the height of the lamps, and z is a default; measure one lamp and give "
            "--height"
        )
    if found.left_out:
        lines.append("too few or too weak measurements for a position: codes " + ", ".join(map(str, found.left_out)))
    return "\n".join(lines) + "\n"


def remarks(found: Surveyed) -> dict[int, str]:
    """Returns a comment for each lamp: its sigmas, and the smallest distance of the drive."""
    rows = zip(found.found.survey.lamps, found.sigma, found.nearest, strict=True)
    return {lamp.lamp_id: f"x +-{s[0]:.3f}, y +-{s[1]:.3f} m, passed at {near:.1f} m" for lamp, s, near in rows}
