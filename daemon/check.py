"""``lumiloop check``: whether configuration and survey are good, and whether the photodiode's bus is here."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from daemon import cli
from daemon.config import Config


def main(args: argparse.Namespace) -> int:
    """The command ``check``; ``args.settings`` is the configuration, which has been found good by now.

    A bus that is not here is a remark, not a refusal: files are also checked on other computers.
    """
    settings: Config = args.settings
    remarks = []
    if settings.lights.survey:
        from daemon.photodiode import profile_of
        from daemon.surveyfile import SurveyError, read_survey

        try:
            survey = read_survey(Path(settings.lights.survey), profile_of(settings.photodiode))
        except SurveyError as error:
            return cli.fail(f"{error} (`lights.survey` in {args.config} names it)", cli.USAGE)
        remarks.append(f"{settings.lights.survey}: good, {len(survey.lamps)} lamps")
        if not settings.photodiode.fitted:
            remarks.append("the survey is not used: `photodiode.bus` is empty")
    if settings.photodiode.fitted:
        remarks.append(_look_at_bus(settings.photodiode.bus))
    sys.stdout.write("".join(f"{line}\n" for line in (f"{args.config}: good", *remarks)))
    return cli.OK


def _look_at_bus(name: str) -> str:
    """One line about the photodiode's bus, which is opened and closed again."""
    import asyncio

    from hal.errors import HalError
    from hal.opening import open_bus

    async def look() -> str:
        bus = await open_bus(name)
        await bus.close()
        return bus.about

    try:
        about = asyncio.run(look())
    except HalError as error:
        return f"as seen from here, {error}"
    return f"{name}: there{f', {about}' if about else ''}; `lumiloop probe {name}` says what answers on it"
