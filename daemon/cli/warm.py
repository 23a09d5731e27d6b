"""``lumiloop warm``: compiles the kernels that a start with this configuration needs."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError
from daemon.runtime import warmup
from daemon.system import console

if TYPE_CHECKING:
    from daemon.devices.light_setup import Lights


def main(args: argparse.Namespace) -> int:
    """Runs the command ``warm``; ``args.settings`` determines whether there is a photodiode.

    If an earlier start has compiled everything, nothing is loaded. The daemon waits for this command at every boot and
    then loads the kernels itself.
    """
    settings: Config = args.settings
    try:
        lights = _lights(settings)
        if warmup.is_warm(lights is not None):
            console.say("an earlier start has compiled the kernels")
            return console.OK
        warmth = warmup.load(lights)
    except SurveyError as error:
        return console.fail(str(error), console.USAGE)
    except warmup.CannotLoad as error:
        return console.fail(str(error))
    console.say(f"kernels compiled in {warmth.seconds:.1f} s")
    return console.OK


def _lights(settings: Config) -> Lights | None:
    """Returns the configured light setup; without one, numpy is not loaded."""
    if not (settings.photodiode.fitted or settings.lights.survey):
        return None
    from daemon.devices.light_setup import load_lights

    return load_lights(settings)
