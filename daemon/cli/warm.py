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

    It loads every kernel, also where an earlier start has compiled them all: a file may have been damaged since.
    """
    settings: Config = args.settings
    try:
        lights = _lights(settings)
        warmth = warmup.load(lights)
    except SurveyError as error:
        return console.fail(str(error), console.USAGE)
    except warmup.CannotLoad as error:
        return console.fail(str(error))
    if warmth.compiled and warmth.unwritten:
        return console.fail(f"kernels compiled in {warmth.seconds:.1f} s; {warmup.EACH} ({warmth.unwritten})")
    if not warmth.compiled:
        console.say(f"the kernels were compiled before; they load in {warmth.seconds:.1f} s")
    else:
        damaged = f"; {warmth.damaged} damaged files were replaced" if warmth.damaged else ""
        console.say(f"kernels compiled in {warmth.seconds:.1f} s{damaged}")
    return console.OK


def _lights(settings: Config) -> Lights | None:
    """Returns the configured light setup; without one, numpy is not loaded."""
    if not (settings.photodiode.fitted or settings.lights.survey):
        return None
    from daemon.devices.light_setup import load_lights

    return load_lights(settings)
