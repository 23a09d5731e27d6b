"""Setup of the light channel: the survey, the air interface, the sample clock, and the residual map.

It is read once and stored in a recording. A replay uses the stored setup, because the survey file may have changed
since.
The head of every segment contains all of it but the residual map, which is large: a file in the recording's folder
holds that.
"""

from __future__ import annotations

import base64
import hashlib
import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgspec

from daemon.config.residual_file import MOST_BYTES
from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError, read_survey, residuals_beside
from daemon.devices.photodiode import profile_of
from daemon.system.regular_file import read_regular
from estimator import PROFILES, Profile, Survey

log = logging.getLogger(__name__)

HEADER: Final = "lights"
"""Key in a recording's head."""
RESIDUALS: Final = "lights.residuals.npz"
"""File name in the recording's folder."""


@dataclass(frozen=True, slots=True)
class Lights:
    """Light channel of a robot with a photodiode.

    Attributes:
        survey: lamps and receiver; without lamps in it, they have to send their own data.
        profile: air interface. clock_ppm: stored error of the sample clock; None: to be found.
        residuals: content of the residual map beside the survey, empty without one; read by the estimator's loader.
    """

    survey: Survey
    profile: Profile
    clock_ppm: float | None = None
    residuals: bytes = b""

    def header(self) -> dict[str, Any]:
        """Entry for the head of every segment of a recording."""
        kept = {
            "survey": msgspec.to_builtins(self.survey),
            "profile": self.profile.name,
            "clock_ppm": self.clock_ppm,
            "residuals_sha256": _digest(self.residuals),
        }
        return {HEADER: kept}


def load_lights(settings: Config, clock_ppm: float | None = None) -> Lights | None:
    """Read the configured light setup; None where there is no photodiode.

    Raises:
        SurveyError: the survey cannot be used; the text contains the position and the remedy.
    """
    path = settings.lights.survey
    profile = profile_of(settings.photodiode)
    survey = read_survey(Path(path), profile) if path else Survey(depth=profile.depth)
    if not settings.photodiode.fitted:
        return None
    return Lights(survey, profile, clock_ppm, _residuals_or_none(Path(path)) if path else b"")


def read_residuals(survey: Path) -> bytes:
    """Content of the residual map beside a survey, empty where there is none; raises `SurveyError`."""
    path = residuals_beside(survey)
    try:
        return read_regular(path, MOST_BYTES)
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise SurveyError(f"{path}: cannot be read: {error.strerror}; correct it, or move the file away") from error


def _residuals_or_none(survey: Path) -> bytes:
    """As :func:`read_residuals`; a map that cannot be read is logged, and the robot drives without it."""
    try:
        return read_residuals(survey)
    except SurveyError as error:
        log.warning("%s; the daemon runs without it", error)
        return b""


def from_header(header: dict[str, Any], folder: Path | None = None) -> Lights | None:
    """Light setup of a recording; None where it had no photodiode.

    ``folder`` is that of its segments. If it does not contain the residual map, the setup has none
    (:func:`lost_residuals`).

    Raises:
        ValueError: the header is not of this version.
    """
    kept = header.get(HEADER)
    if kept is None:
        return None
    try:
        survey = msgspec.convert(kept["survey"], Survey)
        inside = base64.b64decode(
            kept.get("residuals", ""), validate=True
        )  # recordings of an early version contain it here
        residuals = inside or _kept_residuals(folder, kept.get("residuals_sha256", ""))
        return Lights(survey, PROFILES[kept["profile"]], kept["clock_ppm"], residuals)
    except (KeyError, TypeError, ValueError, msgspec.ValidationError) as error:
        raise ValueError(f"the light configuration of the recording is of another version ({error})") from error


def lost_residuals(header: dict[str, Any], lights: Lights) -> bool:
    """Whether a recording was made with a residual map that is now missing or changed."""
    return bool(header[HEADER].get("residuals_sha256")) and not lights.residuals


def _kept_residuals(folder: Path | None, digest: str) -> bytes:
    """Residual map in a recording's folder; empty where its digest differs."""
    if folder is None or not digest:
        return b""
    try:
        content = (folder / RESIDUALS).read_bytes()
    except OSError:
        return b""
    return content if _digest(content) == digest else b""


def _digest(residuals: bytes) -> str:
    return hashlib.sha256(residuals).hexdigest() if residuals else ""
