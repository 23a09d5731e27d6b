"""The first message to a page: name, meanings of numbers, permitted commands, positions of the lamps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from daemon.config.schema import Config
from daemon.devices.light_setup import load_lights
from daemon.publish import meanings
from daemon.publish.modbus.timing_block import RUNGS
from daemon.snapshot import Stage
from estimator import Survey
from taps.view.orders import NAMES

PROTOCOL: Final = 1
"""Version of the messages between page and server; a page of another version reloads itself."""


class SceneUnreadable(Exception):
    """Configuration or survey cannot be read; the text gives the cause."""


@dataclass(frozen=True, slots=True)
class Scene:
    """Data of the picture that the stream does not carry.

    Attributes:
        name: of the robot. mount: x, y (m), yaw (deg), whether upside down. lamps: number, code, x, y each.
        budget_ms: of a cycle, 0: half a scan period. alert_m: alert limit, 0: none.
    """

    name: str
    mount: tuple[float, float, float, bool] = (0.0, 0.0, 0.0, False)
    lamps: list[tuple[int, int, float, float]] = field(default_factory=list)
    budget_ms: float = 0.0
    alert_m: float = 0.0


def scene_of(settings: Config, survey: Survey | None = None) -> Scene:
    """The scene of a configuration and its survey.

    Raises:
        SurveyError: the survey cannot be read.
    """
    if survey is None and settings.photodiode.fitted and settings.lights.survey:
        lights = load_lights(settings)
        survey = None if lights is None else lights.survey
    mount = settings.lidar.mount
    return Scene(
        settings.name,
        (mount.x, mount.y, mount.yaw, mount.inverted),
        [] if survey is None else [(lamp.lamp_id, lamp.code, lamp.x, lamp.y) for lamp in survey.lamps],
        settings.cycle.budget_ms,
        settings.integrity.alert_m,
    )


def welcome(scene: Scene, page: str, order: bool, recording: Path | None) -> dict[str, Any]:
    """The first message to a page."""
    return {
        "protocol": PROTOCOL,
        "page": page,
        "name": scene.name,
        "mount": scene.mount,
        "lamps": scene.lamps,
        "budget_ms": scene.budget_ms,
        "alert_m": scene.alert_m,
        "recording": None if recording is None else recording.name,
        "orders": {name: meanings.COMMANDS[code] for name, code in NAMES.items()} if order else {},
        "states": _table(meanings.STATES),
        "uses": _table(meanings.USES),
        "fixes": _table(meanings.FIXES),
        "loops": _table(meanings.LOOPS),
        "stages": [stage.name.lower() for stage in Stage],
        "rungs": list(RUNGS),
    }


def _table(words: Mapping[Any, str]) -> dict[str, list[str]]:
    """Name and meaning by number, from a table by members of an enumeration."""
    return {str(int(key)): [key.name, text] for key, text in words.items()}
