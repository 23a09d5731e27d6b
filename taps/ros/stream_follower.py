"""Reads the daemon's live stream and passes it as ROS 2 messages to a sender (a node, a Foxglove server)."""

from __future__ import annotations

import contextlib
from typing import Protocol

from daemon.config.schema import Config
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Hello
from daemon.system import console
from taps.ros.messages import RosMessage, Translator


class Sender(Protocol):
    """A receiver of ROS 2 messages."""

    def send(self, out: RosMessage) -> None:
        """Send one message."""


async def forward(stream: Stream, settings: Config, sender: Sender) -> None:
    """Convert and send the whole stream until cancelled.

    Raises:
        NotTheStream: the other end is no daemon of this version.
    """
    translator = Translator(settings.lidar.mount)
    async with contextlib.aclosing(stream.frames()) as frames:
        async for frame in frames:
            if isinstance(frame, Lost):
                console.say(f"{frame.text}; waiting")
            elif isinstance(frame, Hello):
                translator.restart()
            else:
                for out in translator.convert(frame):
                    sender.send(out)
