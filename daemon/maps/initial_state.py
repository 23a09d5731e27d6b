"""Initial estimator state: empty or from a stored map, with the residual map where there is one."""

from __future__ import annotations

import hashlib
import logging
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Final

from daemon.config.paths import maps_folder
from daemon.config.schema import MapConfig
from daemon.devices.light_setup import Lights
from daemon.maps.container import MOST_BYTES, Damaged
from daemon.maps.schema import read
from daemon.maps.store import Start, Store, judge_for
from daemon.system.patience import within
from daemon.system.regular_file import read_regular

if TYPE_CHECKING:  # the warm-up loads the estimator in a thread
    from estimator import LightsSetup, ResidualMap, Settings, State

log = logging.getLogger(__name__)

MAPS_S: Final = 60.0
"""Longest wait for the folder of maps at the start, s."""


class CannotBegin(Damaged):
    """A map that passes every check of its file, but with which the estimator cannot start."""

    remedy = "the daemon keeps the file and uses the previous generation; report the defect with the file"


def new_state(lights: Lights | None, settings: Settings | None = None, start: Start | None = None) -> State:
    """Estimator state after power-on, with the map with which it starts; loads the estimator.

    A residual map that cannot be used is logged by name, and the robot drives without it.

    Raises:
        CannotBegin: the map is at fault. ValueError: the survey or the stored sample clock is.
    """
    import estimator

    setup = None if lights is None else setup_of(lights)
    if start is None:
        return estimator.new_state(settings, setup)
    from daemon.maps.image import image_from
    from estimator import restored

    settings = replace(settings or estimator.Settings(), localise=start.localise)
    try:
        return restored(image_from(start.stored, start.changed), settings, setup)
    except Exception as error:  # a failure that no check covers must not end this start and every later one
        estimator.new_state(settings, setup)  # an error that occurs without the map too is not the map's
        if isinstance(error, MemoryError):
            raise
        raise CannotBegin(f"the file passes every check, but cannot be loaded: {error!r}") from error


def begun(lights: Lights | None, settings: Settings, start: Start | None) -> State:
    """The same for a replay: a run that started without its defective map is repeated in that way."""
    try:
        return new_state(lights, settings, start)
    except CannotBegin as error:
        log.error("the daemon does not use the stored map: %s", error)
        return new_state(lights, settings)


def setup_of(lights: Lights) -> LightsSetup:
    """Light setup as an estimator type; a residual map that cannot be used is logged by name."""
    from estimator import LightsSetup

    return LightsSetup(lights.survey, lights.profile, lights.clock_ppm, _learned(lights))


def _learned(lights: Lights) -> ResidualMap | None:
    """The residual map, None where there is none or it cannot be used."""
    if not lights.residuals:
        return None
    from daemon.config.residual_file import ResidualError, unpack

    try:
        residuals = unpack(lights.residuals, lights.survey, "the residual map beside the survey")
    except ResidualError as error:
        log.warning("%s; the daemon runs without it", error)
        return None
    log.info("residual map of %d lamps loaded", len(residuals.lamp_ids))
    return residuals


class NoMap(Exception):
    """No usable map exists, but the configuration requires one; the text contains the folder and the remedy."""


def started(config: MapConfig, lights: Lights | None, mend: bool = True) -> tuple[Store | None, Start | None]:
    """Map folder and initial map of a run, each None where there is none.

    Raises:
        NoMap: the configuration requires a stored map, and none can be used.
    """
    if not config.kept:
        return None, None
    store = Store(maps_folder(config.folder), mend)
    if mend and not config.localise:
        store.claim()
    start = store.load(judge_for(lights))
    if start is None and config.localise:
        raise NoMap(
            f"{store.folder}: the folder has no usable map, but `map.localise` is true; make a map with "
            "`map.localise = false`, or use `lumiloop map import`"
        )
    if start is None and store.refused:
        log.error("no map in %s can be used; the daemon begins a new one", store.folder)
    if start is not None:
        start = replace(start, localise=config.localise)
        meta = start.stored.meta
        named = f" ({meta.name})" if meta.name else ""
        count = len(start.stored.tables["submap.key"])
        log.info("map %08x%s of %d submaps loaded from %s", meta.map_id, named, count, store.folder)
    return store, start


def started_in_time(config: MapConfig, lights: Lights | None) -> tuple[Store | None, Start | None]:
    """As :func:`started`, on a disk that may not answer: after a minute the run goes on without the stored map.

    Raises:
        NoMap: the configuration requires a stored map, and none can be used.
    """

    def unlock(found: tuple[Store | None, Start | None]) -> None:
        if found[0] is not None:
            found[0].close()

    try:
        return within(MAPS_S, partial(started, config, lights), unlock)
    except TimeoutError as error:
        folder = maps_folder(config.folder)
        if config.localise:
            raise NoMap(f"{folder}: {error.strerror}, but `map.localise` is true") from error
        log.error("maps in %s cannot be read: %s; the daemon begins a new map", folder, error.strerror)
        store = Store(folder)
        store.damaged = True
        return store, None


def recorded_start(path: Path, sha256: str, lights: Lights | None, localise: bool = False) -> Start:
    """The initial map of a recorded run, from the recording's folder.

    Raises:
        OSError: it cannot be read. BadMap: it is not the one with which the run started, or is damaged.
    """
    content = read_regular(path, MOST_BYTES)
    if hashlib.sha256(content).hexdigest() != sha256:
        raise Damaged(f"{path.name} is not the map from the start of the recorded run")
    stored = read(content)
    return Start(content, stored, judge_for(lights)(stored)[1], localise)
