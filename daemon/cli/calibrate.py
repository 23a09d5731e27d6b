"""`lumiloop calibrate REC`: calibrates lamps and receiver, or odometry and lidar mount, from a recorded drive.

Prints residuals before and after, and every parameter with its sigma. Writes the calibrated survey, the residual map
beside it, and a plot. For odometry and lidar mount it writes the configuration (`daemon/commissioning/odometry.py`).
Existing files are replaced only with ``--force``.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path

import numpy as np

from daemon.commissioning.fit_plot import draw_calibration, draw_wheels
from daemon.commissioning.odometry import configuration_lines, findings, fit_drive, with_mount
from daemon.commissioning.teach_drive import Drive, heard, read_drive, rows_for
from daemon.config import loader
from daemon.config.loader import ConfigError, refuse_overwriting
from daemon.config.residual_file import ResidualError, write_residuals
from daemon.config.survey_loader import SurveyError, read_survey, residuals_beside, write_survey
from daemon.replay.recorded_inputs import Given
from daemon.system import console
from estimator import Array, ResidualMap, Survey
from estimator.calibration import (
    COMMONS,
    Calibrated,
    Common,
    Estimate,
    Heard,
    Priors,
    Rows,
    TooLittle,
    Unaligned,
    align,
    calibrate_lamps,
    learn,
    placed,
    survey,
)
from hal.errors import HalError

SURVEY_OUT = Path("lights-calibrated.toml")
CONFIG_OUT = Path("lumiloop-calibrated.toml")
FRAME = Priors(frame=0.15, frame_yaw=0.05)
"""Sigmas of the alignment found from lamp positions."""


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    keys = tuple(override.partition("=")[0].strip() for override in args.set)
    wheels = args.odometry or args.lidar_mount
    args.out = args.out or (CONFIG_OUT if wheels else SURVEY_OUT)
    try:
        refuse_overwriting(args.out, args.force)  # before the work, not after it
        drive = read_drive(args.source, args.settings, Given(args.config is not None, keys))
        for sentence in drive.warnings:
            console.say(sentence)
        if wheels:
            return calibrate_wheels(drive, args)
        return _lights(args, drive)
    except (HalError, ConfigError, SurveyError, ResidualError, TooLittle, Unaligned) as error:
        return console.fail(f"{args.log}: {error}" if isinstance(error, ValueError) else str(error))


def _lights(args: argparse.Namespace, drive: Drive) -> int:
    given = read_survey(args.survey, drive.profile) if args.survey else drive.survey
    if not given.lamps:
        raise SurveyError(
            f"{drive.path}: the recording has no survey; name one with --survey, or make one with `lumiloop survey`"
        )
    strengths = heard(drive)
    start = np.array(args.start) if args.start else found_frame(given, strengths)
    if args.start:
        start[2] = math.radians(start[2])
    rows = rows_for(given, strengths, start)
    found = calibrate_lamps(given, rows, FRAME, start)
    residuals = learn(found.survey, in_survey(found, found.rows))
    sys.stdout.write(report(found, residuals))
    write_survey(args.out, found.survey, notes(drive, found), remarks(found), force=args.force)
    beside = residuals_beside(args.out)
    write_residuals(beside, residuals, found.survey)
    sys.stdout.write(f"written: {args.out}, {beside}\n{draw_calibration(found, args.out.with_suffix('.png'))}\n")
    return console.OK


def found_frame(given: Survey, strengths: Heard) -> Array:
    """Returns the start of the drive in the survey's frame, from the lamps that the drive locates.

    The start is (x, y, yaw), m, m, rad.

    Raises:
        Unaligned, TooLittle: there is no unique alignment; --start gives it instead.
    """
    try:
        z = float(np.median([lamp.z for lamp in given.lamps]))
        return align(given, survey(strengths, given.receiver, given.depth, z).found.survey)
    except (Unaligned, TooLittle) as error:
        raise type(error)(f"{error}; give the start pose in the survey's frame with --start X Y DEGREES") from error


def in_survey(found: Calibrated, rows: Rows) -> Rows:
    """Returns the rows with their poses in the survey's frame."""
    theta = np.zeros(COMMONS)
    theta[Common.FRAME_X : Common.FRAME_YAW + 1] = found.T_survey_drive
    return Rows(placed(theta, rows.pose), rows.lamp, rows.amplitude, rows.sigma, rows.t)


def report(found: Calibrated, residuals: ResidualMap) -> str:
    """Returns the results as text."""
    before, after = found.rms()
    x, y, yaw = found.T_survey_drive
    used, total = int(found.used.sum()), len(found.used)
    lines = [
        f"{used} RSS values used of {total} (the rest is outside the field of view, occluded or inconsistent)",
        f"residual of ln RSS, rms: {before:.4f} before, {after:.4f} after",
        f"start pose of the drive: x {x:.3f} m, y {y:.3f} m, yaw {math.degrees(yaw):.2f} deg in the survey's frame",
        f"residual map: {residuals.noise:.4f} remaining residual, one sigma of ln RSS",
        "",
        f"{'lamp':>6} {'parameter':<12} {'before':>10} {'after':>10} {'sigma':>9}",
        *(line(e) for e in found.estimates if not e.name.startswith("frame") and e.lamp_id not in found.untouched),
    ]
    if found.untouched:
        lines += [
            "",
            "too few measurements, only the common gain was changed: lamps " + ", ".join(map(str, found.untouched)),
        ]
    if not found.converged:
        lines += ["", "the fit has not converged; check these values before use"]
    return "\n".join(lines) + "\n"


def line(e: Estimate) -> str:
    """Returns the text line of one parameter."""
    lamp = "all" if e.lamp_id is None else str(e.lamp_id)
    told = "" if e.told else "  not determined by this drive"
    return f"{lamp:>6} {e.name:<12} {e.before:>10.4f} {e.after:>10.4f} {e.sigma:>9.4f} {e.unit}{told}".rstrip()


def notes(drive: Drive, found: Calibrated) -> list[str]:
    """Returns the head comments of the written survey."""
    before, after = found.rms()
    return [
        f"Calibrated from {drive.path.name}: residual of ln RSS {before:.4f} before, {after:.4f} after (rms).",
        "power_w is each lamp's power as this receiver measures it; sigma is one sigma of its ln.",
    ]


def remarks(found: Calibrated) -> dict[int, str]:
    """Returns a comment for each lamp: the sigmas of the parameters that the drive determines."""
    said: dict[int, list[str]] = {}
    for e in found.estimates:
        if e.lamp_id is not None and e.lamp_id not in found.untouched:
            said.setdefault(e.lamp_id, []).append(f"{e.name} +-{e.sigma:.3f}" if e.told else f"{e.name} not determined")
    return {lamp: ", ".join(words) for lamp, words in said.items()}


def calibrate_wheels(drive: Drive, args: argparse.Namespace) -> int:
    """Fits odometry and mount, prints the result, writes configuration and plot; returns the exit code.

    Args:
        drive: with odometry in it.
        args: ``odometry``, ``lidar_mount``: requested parts; ``out``, ``force``: path of the configuration, and whether
        to
            replace it.

    Raises:
        DataInvalid: no odometry in the recording, or too little motion.
        ConfigError: the configuration cannot be written, or exists.
    """
    fit = fit_drive(drive)
    found = findings(fit, args.odometry, args.lidar_mount)
    config = with_mount(drive.config, fit) if args.lidar_mount else drive.config
    sys.stdout.write("\n".join([*found, *(configuration_lines(config) if args.lidar_mount else ())]) + "\n")
    head = [f"Configuration of drive {drive.path.name}, calibrated from it (lumiloop calibrate).", *found]
    loader.write(args.out, config, head, force=args.force)
    sys.stdout.write(f"written: {args.out}\n{draw_wheels(fit, args.out.with_suffix('.png'))}\n")
    return console.OK
