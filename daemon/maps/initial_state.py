"""The estimator's state at a start: empty or with a stored map, and with the residual map where there is one."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import TYPE_CHECKING

from daemon.devices.light_setup import Lights
from daemon.maps.container import Damaged
from daemon.maps.store import Start

if TYPE_CHECKING:  # the estimator is loaded in a thread, by the warm-up
    from estimator import LightsSetup, ResidualMap, Settings, State

log = logging.getLogger(__name__)


class CannotBegin(Damaged):
    """A map that passes every check of its file, and yet the estimator cannot be begun with it."""

    remedy = "it is kept, the generation before it is used; please report it, with the file"


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
