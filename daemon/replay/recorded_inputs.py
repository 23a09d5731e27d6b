"""Configuration, lights and initial map of a replay: the operator's where given, else those of the recorded run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import msgspec

from daemon.config.loader import brought_up
from daemon.config.schema import Config, Mount
from daemon.config.survey_loader import SurveyError
from daemon.devices.light_setup import Lights, from_header, load_lights, lost_residuals
from daemon.maps.container import BadMap
from daemon.maps.initial_state import NoMap, recorded_start, started
from daemon.maps.store import START, Start
from daemon.recording.recorder import MAP
from daemon.replay.sources import Source
from hal.errors import DataInvalid


@dataclass(frozen=True, slots=True)
class Given:
    """Part of the configuration that the operator has set: a whole ``file``, and single ``keys`` (dotted paths)."""

    file: bool = False
    keys: tuple[str, ...] = ()


NOTHING_GIVEN: Final = Given()


def config_for(source: Source, config: Config, given: Given) -> Config:
    """Returns the effective configuration: the operator's, else the recording's.

    If no lidar mount was given, the mount in the log is used.
    """
    if source.recorded and not given.file:
        tree = brought_up(dict(source.header.get("config", {})))
        try:
            return msgspec.convert(_laid_over(tree, msgspec.to_builtins(config), given.keys), Config)
        except msgspec.ValidationError as error:
            source.report.notes.append(
                f"the configuration of the recording is of another version and is not used ({error})"
            )
    asked = any(key.startswith("lidar.mount") for key in given.keys) or config.lidar.mount != Mount()
    if source.mount is None or asked:
        return config
    x, y, yaw = source.mount
    lidar = msgspec.structs.replace(config.lidar, mount=Mount(x=x, y=y, yaw=math.degrees(yaw)))
    return msgspec.structs.replace(config, lidar=lidar)


def lights_for(source: Source, used: Config, given: Given) -> Lights | None:
    """Returns the light setup as recorded, unless the operator has set another survey or none.

    The recorded sample clock is used in any case, except for another air interface than the recorded one.

    Raises:
        DataInvalid: the recorded light setup or the requested survey cannot be used.
    """
    if not (source.recorded and used.photodiode.fitted):
        return None
    asked = given.file or any(key.startswith(("lights.", "photodiode.")) for key in given.keys)
    try:
        return load_lights(used, _recorded_clock(source, used)) if asked else _recorded_lights(source)
    except (SurveyError, ValueError) as error:
        raise DataInvalid(str(source.path), str(error), "name a survey with --set lights.survey=FILE") from error


def start_for(source: Source, used: Config, lights: Lights | None, given: Given) -> Start | None:
    """Returns the initial map of the run; None: without a map.

    A map of ``map.folder`` is used only if the operator has requested it.

    Raises:
        DataInvalid: the requested or recorded map cannot be used.
    """
    if source.begin is not None:
        return None
    try:
        named = given.file and used.map.folder and not source.recorded
        if named or any(key.startswith("map.") for key in given.keys):
            store, start = started(used.map, lights, mend=False)
            if store is not None and start is None:
                lacks = f"{store.folder} holds no usable map"
                if "map.folder" in given.keys:
                    raise DataInvalid(str(source.path), lacks, "name another folder, or --set map.folder=none")
                source.report.notes.append(f"{lacks}; the replay runs without one")
            return start
        if not source.recorded or MAP not in source.header:
            return None
        path, sha256 = source.files[0].parent / START, source.header[MAP]["sha256"]
        return recorded_start(path, sha256, lights, used.map.localise)
    except (NoMap, BadMap, OSError) as error:
        remedy = "replay the recording with its original files, or name a map with --set map.folder=DIR"
        raise DataInvalid(str(source.path), f"its initial map cannot be used: {error}", remedy) from error


def _recorded_lights(source: Source) -> Lights | None:
    folder = source.files[0].parent
    lights = from_header(source.header, folder)
    if lights is not None and lost_residuals(source.header, lights):
        source.report.notes.append(f"its residual map is missing in {folder} or damaged; the replay runs without it")
    return lights


def _recorded_clock(source: Source, used: Config) -> float | None:
    """Returns the sample clock error of the recorded run, ppm; None if it cannot apply to this run."""
    try:
        recorded = from_header(source.header)
    except ValueError:
        return None
    same = recorded is not None and recorded.profile.name == used.photodiode.profile
    return recorded.clock_ppm if recorded is not None and same else None


def _laid_over(tree: dict[str, Any], config: dict[str, Any], keys: tuple[str, ...]) -> dict[str, Any]:
    """Returns ``tree`` with the values that ``config`` has for ``keys`` (dotted paths)."""
    for key in keys:
        branch, chosen = tree, config
        *parents, last = key.split(".")
        for parent in parents:
            branch, chosen = branch.setdefault(parent, {}), chosen[parent]
        branch[last] = chosen[last]
    return tree
