"""`lumiloop view`: serves the web page of a running daemon, or of a recording."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import errno
import multiprocessing
import os
import socket
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Final

from aiohttp import web

from daemon.cli.status import address_of
from daemon.config import loader
from daemon.config.endpoints import in_url
from daemon.config.schema import Config
from daemon.config.survey_loader import SurveyError
from daemon.publish.modbus.client import NoAnswer
from daemon.publish.stream.client import Stream
from daemon.replay.sources import open_log
from daemon.system import console
from daemon.system.logging import to_journal
from hal.errors import HalError
from hal.run_server import stop_event
from taps.access_guard import Guard, TokenRefused, token_for
from taps.view.page_hello import Scene, SceneUnreadable, scene_of
from taps.view.replay_file import ReplayFile, end_message
from taps.view.server import TOPICS, View

PORT: Final = 8090
NICENESS: Final = 5
"""Niceness of the process: the page must not delay a pose."""


def main(args: argparse.Namespace) -> int:
    """Body of the command; returns the exit code."""
    with contextlib.suppress(OSError):
        os.nice(NICENESS)
    try:
        token = token_for(args.bind, args.write, args.token)
        if token and args.token is None and to_journal():
            raise CannotServe("a new token would be visible only in the log; name a file with a token, --token FILE")
        return _show(args, Guard(args.bind, token, args.write))
    except (TokenRefused, SurveyError, NoAnswer, CannotServe) as error:
        return console.fail(str(error))


class CannotServe(Exception):
    """The page cannot be served; the text gives the cause and a remedy."""


def _show(args: argparse.Namespace, guard: Guard) -> int:
    settings: Config = args.settings
    if args.log is None:
        modbus = address_of(None, settings) if settings.modbus.port else ("127.0.0.1", 0)
        stream = Stream(args.stream or settings.name, TOPICS)
        view = View(
            guard, scene_of(settings), stream, modbus=modbus, again=partial(_scene, args.source.file, tuple(args.set))
        )
        return _serve(view, guard, args.port, f"lumiloop {settings.name}")
    if args.write:
        return console.fail("a recording accepts no commands; omit --write", console.USAGE)
    if not args.log.exists():
        return console.fail(f"{args.log}: no such recording")
    with _film(args) as film:
        return _serve(View(guard, Scene(settings.name), film=film), guard, args.port, f"recording {args.log}")


def _scene(file: Path | None, words: tuple[str, ...]) -> Scene:
    """The scene of the present configuration and survey.

    Raises:
        SceneUnreadable: one of them cannot be read.
    """
    try:
        return scene_of(loader.load(file, list(words)))
    except (loader.ConfigError, SurveyError) as error:
        raise SceneUnreadable(str(error)) from None


@contextlib.contextmanager
def _film(args: argparse.Namespace) -> Iterator[ReplayFile]:
    """The replay file of the recording, which another process writes meanwhile.

    Raises:
        CannotServe: the recording cannot be read.
    """
    keys = tuple(override.partition("=")[0].strip() for override in args.set)
    with tempfile.TemporaryDirectory(prefix="lumiloop-view-") as folder:
        file = Path(folder) / "film"
        file.touch()
        given = args.config is not None, keys
        maker = multiprocessing.get_context("spawn").Process(
            target=_record, args=(args.log, args.settings, given, file), name="film", daemon=True
        )
        maker.start()
        film = ReplayFile(args.log, file, maker.is_alive)
        try:
            _wait(film)
            yield film
        finally:
            maker.terminate()
            maker.join()
            film.close()


def _record(log: Path, settings: Config, given: tuple[bool, tuple[str, ...]], out: Path) -> None:
    """The writing process: only it loads the estimator, which may have to be compiled."""
    from daemon.runtime import warmup

    try:
        source = open_log(log)
    except HalError as error:
        out.write_bytes(end_message(0.0, str(error)))
        return
    try:
        warmup.load_aloud(console.say, "warm", warmup.load, "taps.view.replay_recorder")
    except warmup.CannotLoad as error:
        console.fail(str(error))
        return
    try:
        import_module("taps.view.replay_recorder").record(source, settings, given, out)
    except OSError as error:
        console.fail(f"{out}: {error.strerror}; the recording is shown up to there")


def _wait(film: ReplayFile) -> None:
    """Wait until the recording has proved readable."""
    console.say("replaying the recording; the page shows it meanwhile")
    while film.scene is None and not film.done:
        time.sleep(0.05)
        film.refresh()
    if film.error:
        raise CannotServe(film.error)


def _serve(view: View, guard: Guard, port: int, what: str) -> int:
    """Serve until interrupted."""
    try:
        asyncio.run(_until_signal(view, guard, port, what))
    except OSError as error:
        taken = error.errno == errno.EADDRINUSE
        remedy = "name another with --port" if taken else "name an address of this computer with --bind"
        raise CannotServe(f"{guard.bind} port {port}: {error.strerror or error}; {remedy}") from None
    return console.OK


async def _until_signal(view: View, guard: Guard, port: int, what: str) -> None:
    stop = stop_event()
    runner = view.runner()
    await runner.setup()
    try:
        site = web.TCPSite(runner, guard.bind, port)
        await site.start()
        console.say(f"{what}: {address(guard, _port_of(runner), whole=not to_journal())}")
        await stop.wait()
    finally:
        await runner.cleanup()


def _port_of(runner: web.AppRunner) -> int:
    """The actual port, where port 0 was requested."""
    return int(runner.addresses[0][1])


def address(guard: Guard, port: int, whole: bool = True) -> str:
    """The URL for a person; the token is in the fragment, which browsers do not send to servers.

    Not ``whole``: for a log, with the token replaced by dots.
    """
    host = guard.bind
    if host in ("0.0.0.0", "::", ""):
        host = socket.gethostname()
    token = guard.token if whole else "..."
    return f"http://{in_url(host)}:{port}/" + (f"#token={token}" if guard.token else "")
