"""`lumiloop record-mcap OUT.mcap`: records the running daemon's stream as an MCAP file of ROS 2 messages.

It stops while the disk still has room for the daemon's maps (``--reserve``). A killed recorder leaves a file without an
index that lacks at most half a second; `lumiloop export FILE.mcap --mcap WHOLE.mcap` recovers it.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
from pathlib import Path
from typing import Final

from daemon.config.schema import Config
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Hello, NotTheStream
from daemon.system import console
from hal.run_server import run_until_stopped
from taps.mcap.writer import FLUSH_S, McapFile, NoRoom
from taps.ros.messages import Translator

TOPICS: Final = ("pose", "lights", "scan", "state", "loop", "faults", "statistics", "map")


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    if args.out.exists() and not args.force:
        return console.fail(f"{args.out} exists already; name another file, or replace it with --force", console.USAGE)
    if not args.out.parent.is_dir():
        return console.fail(f"{args.out}: no folder {args.out.parent}; create it, or name another file", console.USAGE)
    stream = Stream(args.stream or args.settings.name, (*TOPICS, *(["raw"] if args.raw else [])))
    file = None
    try:
        with McapFile(args.out, reserve=round(args.reserve * (1 << 20))) as file:
            asyncio.run(run_until_stopped(record(stream, args.settings, file), seconds=args.seconds or 0.0))
    except NotTheStream as error:
        return console.fail(str(error))
    except NoRoom as error:
        whole = "the file is complete up to here; " if file is not None and file.messages else ""
        return console.fail(f"{args.out}: stopped, {error}: {whole}free space, or name another disk")
    except OSError as error:
        return console.fail(f"{args.out}: {error.strerror}; free space or name another file")
    finally:
        if file is not None and not file.messages:
            _remove_if_file(args.out)
    if not file.messages:
        return console.fail("no data were received, so no file was written; check that the daemon runs")
    console.say(f"{args.out}: {file.messages} messages")
    return console.OK


def _remove_if_file(path: Path) -> None:
    """Remove an empty file: a rotation of the latest files would delete a full one for it."""
    if path.is_file():  # not a device
        with contextlib.suppress(OSError):
            path.unlink()


async def record(stream: Stream, settings: Config, file: McapFile) -> None:
    """Write the stream until cancelled.

    Raises:
        NotTheStream: the other end is no daemon of this version.
        OSError: the file cannot be written.
        NoRoom: its disk has no room beyond the reserve.
    """
    translator = Translator(settings.lidar.mount, ordered=True)
    flushing = asyncio.ensure_future(_flush(file))
    try:
        async with contextlib.aclosing(stream.frames()) as frames:
            async for frame in frames:
                if isinstance(frame, Lost):
                    console.say(f"{frame.text}; waiting")
                elif isinstance(frame, Hello):
                    console.say(f"recording {frame.name} to {file.path}")
                    translator.restart()
                else:
                    for out in translator.convert(frame):
                        file.write(out)
    finally:
        flushing.cancel()
        await asyncio.gather(flushing, return_exceptions=True)


async def _flush(file: McapFile) -> None:
    """Flush buffered messages also when no further ones arrive."""
    while True:
        await asyncio.sleep(FLUSH_S)
        if file.waiting:
            with contextlib.suppress(NoRoom):  # the next message raises it again
                file.flush()
