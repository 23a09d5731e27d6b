"""``lumiloop warm``: compile the kernels that a start with this configuration will need, so that it need not."""

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
    """The command ``warm``; ``args.settings`` says whether there is a photodiode.

    Where an earlier start has compiled all of it nothing is loaded: the daemon, which waits for this at every boot,
    loads it itself.
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
    """What the configuration says of them; where it says nothing, numpy is not loaded to learn that."""
    if not (settings.photodiode.fitted or settings.lights.survey):
        return None
    from daemon.devices.light_setup import load_lights

    return load_lights(settings)
