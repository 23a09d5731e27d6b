"""Client of the daemon's local stream: connects, subscribes to topics, and reconnects after a loss.

async for frame in Stream(path, ("pose", "scan")).frames():
    match frame:
        case Hello(): ...       # connected, or connected again
        case Lost(): ...        # the daemon has gone; messages continue when it is back
        case Pose(): ...
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import AsyncGenerator, AsyncIterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from daemon.config.paths import SERVICE, daemons_in, stream_path
from daemon.publish.stream import messages
from daemon.publish.stream.messages import LONGEST, Frame, NotTheStream, Refused
from daemon.publish.stream.server import TOPICS

FIRST_RETRY_S: Final = 0.2
LAST_RETRY_S: Final = 2.0
SILENT_S: Final = 10.0
"""Time in s without a greeting after which the daemon counts as stalled, or the path as another program's."""


@dataclass(frozen=True, slots=True)
class Lost:
    """Loss of the connection; ``text`` is the reason. It comes once, not at each attempt."""

    text: str


class Stream:
    """Messages of a daemon, for as long as they are iterated.

    Args:
        path: of the socket; or the name of a daemon, whose socket is located at each attempt.
        topics: to subscribe to.
        patient: whether to retry after a loss, and when there is no daemon at first.

    Raises:
        ValueError: no such topic.
    """

    def __init__(self, path: Path | str, topics: Sequence[str], patient: bool = True) -> None:
        if unknown := sorted(set(topics) - set(TOPICS)):
            raise ValueError(f"no such topic: {', '.join(unknown)}; available: {', '.join(TOPICS)}")
        self._of, self.topics, self.patient = path, tuple(topics), patient

    @property
    def path(self) -> Path:
        """Path of the socket, as far as it is available now."""
        return stream_path(self._of) if isinstance(self._of, str) else self._of

    async def frames(self) -> AsyncGenerator[Frame | Lost, None]:
        """All messages, from the greeting on; ends after :class:`Lost` if not patient. The caller closes it.

        Raises:
            NotTheStream: the data cannot be read, or our request was refused; another attempt would not help.
        """
        retry, told = FIRST_RETRY_S, False
        while True:
            path = self.path
            try:
                async with _connected(path) as (reader, writer):
                    writer.write(messages.request(self.topics))
                    async with contextlib.aclosing(_frames(reader)) as heard:
                        async for frame in heard:
                            retry, told = FIRST_RETRY_S, False
                            yield frame
                    lost = f"{path}: the daemon closed the stream"
            except OSError as error:
                lost = f"{path}: {_why(error)}"
                if not told and _nobody(error):
                    lost += _others(path)
            if not told:
                told = True
                yield Lost(lost)
            if not self.patient:
                return
            await asyncio.sleep(retry)
            retry = min(2.0 * retry, LAST_RETRY_S)


@contextlib.asynccontextmanager
async def _connected(path: Path) -> AsyncIterator[tuple[asyncio.StreamReader, asyncio.StreamWriter]]:
    reader, writer = await asyncio.open_unix_connection(str(path), limit=1 << 20)
    try:
        sock: socket.socket | None = writer.get_extra_info("socket")
        if sock is not None:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1 << 20)
        yield reader, writer
    finally:
        writer.transport.abort()  # no unsent data is worth waiting for


async def _frames(reader: asyncio.StreamReader) -> AsyncGenerator[Frame, None]:
    """Messages until the daemon closes; topics that this version does not define are skipped."""
    greeted = False
    while (body := await _body(reader, None if greeted else SILENT_S)) is not None:
        frame = messages.decode(body)
        if not greeted and not isinstance(frame, (messages.Hello, Refused)):
            raise NotTheStream("the peer sends no hello message, so it is not a lumiloop daemon")
        greeted = True
        if isinstance(frame, Refused):
            raise NotTheStream(f"the daemon refuses the connection: {frame.text}")
        if frame is not None:
            yield frame


async def _body(reader: asyncio.StreamReader, patience_s: float | None) -> bytes | None:
    """Body of the next message without its length; None: closed, also in the middle of one."""
    try:
        async with asyncio.timeout(patience_s):
            length = int.from_bytes(await reader.readexactly(4), "little")
            if length > LONGEST:
                raise NotTheStream(f"a message has {length} bytes, so this is not a lumiloop stream")
            return await reader.readexactly(length)
    except asyncio.IncompleteReadError:
        return None
    except TimeoutError:
        raise OSError(f"no message for {SILENT_S:.0f} s; the daemon does not respond") from None


def _nobody(error: OSError) -> bool:
    return isinstance(error, (FileNotFoundError, ConnectionRefusedError))


def _others(path: Path) -> str:
    """List of daemons that may be meant: without `--config`, the client uses the default name."""
    names = sorted({name for folder in {path.parent, SERVICE} for name in daemons_in(folder)} - {path.stem})
    runs = "runs" if len(names) == 1 else "run"
    return f"; {', '.join(names)} {runs} here: `--set name={names[0]}`, or `--config`" if names else ""


def _why(error: OSError) -> str:
    if _nobody(error):
        return "no daemon listens there; start `lumiloop run`, or name the stream that its log shows"
    if isinstance(error, PermissionError):
        return "access denied; the user needs access to its folder"
    return error.strerror or str(error)
