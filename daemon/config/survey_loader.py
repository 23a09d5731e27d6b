"""Lamp survey file (TOML): lamps with positions and light model, and the receiver they were calibrated with.

A lamp is one line. Files that the calibration and survey commands write can be read, edited and written again.
Reading is strict: an unknown key, a lamp without a number or two lamps with one number are errors. All errors are
reported at once, each with the file, the line, the key and what was expected.
The survey's frame becomes the map frame (docs/calibration.md).
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import msgspec

from daemon.config.survey_errors import problems
from daemon.config.survey_schema import SurveyTree
from daemon.system.atomic_file import write_whole
from daemon.system.regular_file import read_named
from estimator import Lamp, Profile, Receiver, Survey

DECIMALS: Final = 6
MOST_BYTES: Final = 16 << 20
"""Largest size of a survey in bytes: 100 000 lamps."""


class SurveyError(Exception):
    """The survey cannot be used or written; the text states where, what was expected and the remedy."""


def residuals_beside(survey: Path) -> Path:
    """Path of the residual map that belongs to a survey (daemon/config/residual_file.py), whether it exists or not."""
    return survey.with_suffix(".residuals.npz")


def read_survey(path: Path, profile: Profile | None = None) -> Survey:
    """Read and check a survey.

    Args:
        path: of the file.
        profile: air interface that the lamps must have; None: any, with the modulation depth of profile A where the
            file contains none.

    Raises:
        SurveyError: missing, unreadable, not TOML, an unknown key, a wrong or implausible value, a lamp twice, a code
            that the profile does not have; all of them, a line each.
    """
    text = _read(path)
    try:
        tree = tomllib.loads(text)
    except RecursionError:
        raise SurveyError(f"{path}: not valid TOML: nested too deeply") from None
    except tomllib.TOMLDecodeError as error:
        raise SurveyError(f"{path}: not valid TOML: {error}") from None
    if found := problems(tree, str(path), text, profile):
        raise SurveyError("\n".join(found))
    return msgspec.convert(tree, SurveyTree).survey(profile)


def write_survey(
    path: Path, survey: Survey, notes: Sequence[str] = (), remarks: Mapping[int, str] | None = None, force: bool = False
) -> None:
    """Write a survey atomically and sync it to the disk; reading it back yields an equal one (to 1e-6).

    Args:
        path: of the file.
        survey: the survey.
        notes: lines of comment at the head.
        remarks: comment behind a lamp, by lamp ID.
        force: replace an existing file.

    Raises:
        SurveyError: the file exists already, or it cannot be written.
    """
    if path.exists() and not force:
        raise SurveyError(f"{path} exists already; name another file, or replace it with --force")
    try:
        write_whole(path, dump(survey, notes, remarks or {}).encode())
    except OSError as error:
        raise SurveyError(f"cannot write {path}: {error.strerror}; free space or name another file") from error


def dump(survey: Survey, notes: Sequence[str] = (), remarks: Mapping[int, str] | None = None) -> str:
    """The survey as TOML, always in the same order."""
    lines = [
        f"# {note}".rstrip() for note in ("Light survey of lumiloop: metres, watts, slopes; frame: the map's.", *notes)
    ]
    lines += ["", f"depth = {_number(survey.depth)}", f"floor = {_number(survey.floor)}", "", "lamp = ["]
    rows = [_lamp_row(lamp) for lamp in sorted(survey.lamps, key=lambda lamp: lamp.lamp_id)]
    widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))] if rows else []
    for lamp, row in zip(sorted(survey.lamps, key=lambda lamp: lamp.lamp_id), rows, strict=True):
        cells = " ".join(f"{cell},".ljust(width + 1) for cell, width in zip(row, widths, strict=True)).rstrip(" ,")
        remark = (remarks or {}).get(lamp.lamp_id, "")
        lines.append(f"  {{ {cells} }},{f'  # {remark}' if remark else ''}")
    lines += ["]", "", "[receiver]", *_receiver_rows(survey.receiver)]
    return "\n".join(lines) + "\n"


def _lamp_row(lamp: Lamp) -> list[str]:
    values = {
        "lamp_id": lamp.lamp_id,
        "code": lamp.code,
        **{name: getattr(lamp, name) for name in ("x", "y", "z", "power_w", "order", "slope_x", "slope_y")},
        "sigma": lamp.sigma_ln,
    }
    return [f"{name} = {_number(value)}" for name, value in values.items()]


def _receiver_rows(receiver: Receiver) -> list[str]:
    values = {
        **{name: getattr(receiver, name) for name in ("x", "y", "z")},
        "area_cm2": 1e4 * receiver.area_m2,
        "responsivity": receiver.responsivity,
        "order": receiver.order,
        "half_fov_deg": math.degrees(receiver.half_fov_rad),
        "slope_x": receiver.slope_x,
        "slope_y": receiver.slope_y,
    }
    return [f"{name} = {_number(value)}" for name, value in values.items()]


def _number(value: float) -> str:
    return repr(value) if isinstance(value, int) else repr(round(float(value), DECIMALS) + 0.0)


def _read(path: Path) -> str:
    try:
        return read_named(path, MOST_BYTES).decode()
    except FileNotFoundError:
        raise SurveyError(f"{path}: no such survey; `lumiloop survey` makes one from a drive") from None
    except UnicodeDecodeError as error:
        raise SurveyError(f"{path}: not UTF-8 text at byte {error.start}") from None
    except OSError as error:
        raise SurveyError(f"{path}: cannot be read: {error.strerror}") from None
