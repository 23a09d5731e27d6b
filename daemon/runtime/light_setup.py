"""What the estimator is told of ceiling lights before it starts: the survey, the air interface, the sample clock.

It is read once, kept in a recording, and taken from there by a replay: the survey file may have changed since. All
of it is in the head of every segment but the residual map, which is large: a file in the recording's folder holds it.
"""

from __future__ import annotations

import base64
import hashlib
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError, read_survey, residuals_beside
from daemon.devices.photodiode import profile_of
from daemon.maps.container import Damaged
from estimator import PROFILES, Profile, Survey

if TYPE_CHECKING:  # the estimator is loaded in a thread, by the warm-up
    from daemon.maps.store import Start
    from estimator import LightsSetup, ResidualMap, Settings, State

log = logging.getLogger(__name__)

__all__ = [
    "CannotBegin",
    "Lights",
    "SurveyError",
    "begun",
    "from_header",
    "load_lights",
    "lost_residuals",
    "new_state",
    "read_residuals",
]

HEADER: Final = "lights"
"""Key of a recording's head."""
RESIDUALS: Final = "lights.residuals.npz"
"""File of a recording's folder."""


class CannotBegin(Damaged):
    """A map that passes every check of its file, and yet the estimator cannot be begun with it."""

    remedy = "it is kept, the generation before it is used; please report it, with the file"


@dataclass(frozen=True, slots=True)
class Lights:
    """A photodiode and what it looks at.

    Attributes:
        survey: lamps and receiver; without lamps in it they have to describe themselves.
        profile: air interface. clock_ppm: stored error of the sample clock; None: to be found.
        residuals: content of the residual map beside the survey, empty without one; read by the estimator's loader.
    """

    survey: Survey
    profile: Profile
    clock_ppm: float | None = None
    residuals: bytes = b""

    def header(self) -> dict[str, Any]:
        """What a recording keeps in the head of every segment."""
        kept = {
            "survey": msgspec.to_builtins(self.survey),
            "profile": self.profile.name,
            "clock_ppm": self.clock_ppm,
            "residuals_sha256": _digest(self.residuals),
        }
        return {HEADER: kept}


def load_lights(settings: Config, clock_ppm: float | None = None) -> Lights | None:
    """What the configuration says of lights; None where there is no photodiode.

    Raises:
        SurveyError: the survey cannot be used; names the place and the remedy.
    """
    path = settings.lights.survey
    profile = profile_of(settings.photodiode)
    survey = read_survey(Path(path), profile) if path else Survey(depth=profile.depth)
    if not settings.photodiode.fitted:
        return None
    return Lights(survey, profile, clock_ppm, read_residuals(Path(path)) if path else b"")


def read_residuals(survey: Path) -> bytes:
    """Content of the map beside a survey, empty where there is none; raises `SurveyError`."""
    path = residuals_beside(survey)
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return b""
    except OSError as error:
        raise SurveyError(f"{path}: cannot be read: {error.strerror}; mend that, or move it away") from error


def from_header(header: dict[str, Any], folder: Path | None = None) -> Lights | None:
    """What a recording was made with; None where it had no photodiode.

    ``folder`` is where its segments lie; without the residual map in it there is none (:func:`lost_residuals`).

    Raises:
        ValueError: it is not of this version.
    """
    kept = header.get(HEADER)
    if kept is None:
        return None
    try:
        survey = msgspec.convert(kept["survey"], Survey)
        inside = base64.b64decode(kept.get("residuals", ""), validate=True)  # as recordings were written at first
        residuals = inside or _kept_residuals(folder, kept.get("residuals_sha256", ""))
        return Lights(survey, PROFILES[kept["profile"]], kept["clock_ppm"], residuals)
    except (KeyError, TypeError, ValueError, msgspec.ValidationError) as error:
        raise ValueError(f"the recording's lights are not of this version ({error})") from error


def lost_residuals(header: dict[str, Any], lights: Lights) -> bool:
    """Whether a recording was made with a residual map that is not there any more, or not as it was."""
    return bool(header[HEADER].get("residuals_sha256")) and not lights.residuals


def _kept_residuals(folder: Path | None, digest: str) -> bytes:
    """The residual map in a recording's folder, empty where it is not the one with that digest."""
    if folder is None or not digest:
        return b""
    try:
        content = (folder / RESIDUALS).read_bytes()
    except OSError:
        return b""
    return content if _digest(content) == digest else b""


def _digest(residuals: bytes) -> str:
    return hashlib.sha256(residuals).hexdigest() if residuals else ""


def new_state(lights: Lights | None, settings: Settings | None = None, start: Start | None = None) -> State:
    """The estimator's state for a robot just switched on, and the map it begins with; loads the estimator.

    A residual map that cannot be used is named in the log, and the robot drives without.

    Raises:
        CannotBegin: the map is at fault. ValueError: the survey or the stored sample clock is.
    """
    import estimator

    setup = None if lights is None else _setup(lights)
    if start is None:
        return estimator.new_state(settings, setup)
    from daemon.maps.image import image_from
    from estimator import restored

    settings = replace(settings or estimator.Settings(), localise=start.localise)
    try:
        return restored(image_from(start.stored, start.changed), settings, setup)
    except Exception as error:  # what no check has foreseen must not end this start, and the next, and the next
        estimator.new_state(settings, setup)  # what is wrong without a map too is not the map's fault
        if isinstance(error, MemoryError):
            raise
        raise CannotBegin(f"it passes every check, but cannot be made into a state: {error!r}") from error


def begun(lights: Lights | None, settings: Settings, start: Start | None) -> State:
    """The same for a replay: the run that began without a map that it could not be begun with is repeated so."""
    try:
        return new_state(lights, settings, start)
    except CannotBegin as error:
        log.error("the stored map is not used: %s", error)
        return new_state(lights, settings)


def _setup(lights: Lights) -> LightsSetup:
    from estimator import LightsSetup

    return LightsSetup(lights.survey, lights.profile, lights.clock_ppm, _learned(lights))


def _learned(lights: Lights) -> ResidualMap | None:
    """The residual map, None where there is none or it is of no use."""
    if not lights.residuals:
        return None
    from daemon.config.residual_file import ResidualError, unpack

    try:
        residuals = unpack(lights.residuals, lights.survey, "the residual map beside the survey")
    except ResidualError as error:
        log.warning("%s; driving without it", error)
        return None
    log.info("residual map of %d lamps", len(residuals.lamp_ids))
    return residuals
