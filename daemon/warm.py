"""``lumiloop warm``: compile the kernels that a start with this configuration will need, so that it need not."""

from __future__ import annotations

import argparse

from daemon import cli, warmup
from daemon.config import Config
from daemon.lights import SurveyError, load_lights


def main(args: argparse.Namespace) -> int:
    """The command ``warm``; ``args.settings`` says whether there is a photodiode.

    Where an earlier start has compiled all of it nothing is loaded: the daemon, which waits for this at every boot,
    loads it itself.
    """
    settings: Config = args.settings
    try:
        lights = load_lights(settings)
        if warmup.is_warm(lights is not None):
            cli.say("an earlier start has compiled the kernels")
            return cli.OK
        warmth = warmup.load(lights)
    except SurveyError as error:
        return cli.fail(str(error), cli.USAGE)
    except warmup.CannotLoad as error:
        return cli.fail(str(error))
    cli.say(f"kernels compiled in {warmth.seconds:.1f} s")
    return cli.OK
