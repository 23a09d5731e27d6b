"""A running daemon's stream as ROS 2 messages, one after the other, for whoever sends them on."""

from __future__ import annotations

import contextlib
from typing import Protocol

from daemon.config.schema import Config
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Hello
from daemon.system import console
from taps.ros.messages import Out, Translator


class Sender(Protocol):
    """Whoever sends them on."""

    def send(self, out: Out) -> None:
        """One message."""


async def follow(stream: Stream, settings: Config, sender: Sender) -> None:
    """Pass on all that is told, until cancelled.

    Raises:
        NotTheStream: the other end is no daemon of this version.
    """
    translator = Translator(settings.lidar.mount)
    async with contextlib.aclosing(stream.frames()) as frames:
        async for frame in frames:
            if isinstance(frame, Lost):
                console.say(f"{frame.text}; waiting")
            elif isinstance(frame, Hello):
                translator = Translator(settings.lidar.mount)
            else:
                for out in translator.take(frame):
                    sender.send(out)
