"""A web page's server, or browsers without eyes, that begin at SIGUSR1 and end at SIGUSR2, over and over.

python -m tools.bench.support.viewers serve STREAM PORT          as `lumiloop view` would
python -m tools.bench.support.viewers watch PORT COUNT           at SIGTERM it prints how many messages and bytes came
"""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Final

from aiohttp import ClientError, ClientSession, WSMsgType, web

from daemon.publish.stream.client import Stream
from taps.access_guard import Guard
from taps.view.command import NICENESS
from taps.view.page_hello import Scene
from taps.view.server import TOPICS, View

AGAIN_S: Final = 0.2
Body = Callable[[], Awaitable[None]]


async def serve(stream: Path, port: int) -> None:
    """The page's server, until it is cancelled."""
    runner = View(Guard("127.0.0.1"), Scene("bench"), Stream(stream, TOPICS)).runner()
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", port).start()
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()


class Browsers:
    """So many that take all that they are told. messages, size: that came."""

    def __init__(self, port: int, count: int) -> None:
        self.messages = self.size = 0
        self._address, self._count = f"http://127.0.0.1:{port}/ws", count

    async def watch(self) -> None:
        """Until it is cancelled."""
        async with ClientSession() as session, asyncio.TaskGroup() as all_of_them:
            for _ in range(self._count):
                all_of_them.create_task(self._one(session))

    async def _one(self, session: ClientSession) -> None:
        while True:
            with contextlib.suppress(ClientError, OSError):
                async with session.ws_connect(self._address, max_msg_size=1 << 24) as socket:
                    await socket.send_json({"page": "bench", "token": None})
                    async for message in socket:
                        if message.type is WSMsgType.BINARY:
                            self.messages += 1
                            self.size += len(message.data)
            await asyncio.sleep(AGAIN_S)


async def in_turns(body: Body) -> None:
    """Begin and end as told, until SIGTERM."""
    loop = asyncio.get_running_loop()
    running: asyncio.Task[None] | None = None
    end = asyncio.Event()

    def begin() -> None:
        nonlocal running
        running = asyncio.ensure_future(body())  # type: ignore[assignment]  # a coroutine makes a task

    def stop() -> None:
        if running is not None:
            running.cancel()

    loop.add_signal_handler(signal.SIGUSR1, begin)
    loop.add_signal_handler(signal.SIGUSR2, stop)
    loop.add_signal_handler(signal.SIGTERM, end.set)
    os.write(1, b"ready\n")
    await end.wait()
    stop()
    if running is not None:
        await asyncio.gather(running, return_exceptions=True)


def main(words: list[str]) -> None:
    """What the parent starts."""
    os.nice(NICENESS)
    if words[0] == "serve":
        asyncio.run(in_turns(lambda: serve(Path(words[1]), int(words[2]))))
        return
    browsers = Browsers(int(words[1]), int(words[2]))
    asyncio.run(in_turns(browsers.watch))
    os.write(1, f"{browsers.messages} {browsers.size}\n".encode())


if __name__ == "__main__":
    main(sys.argv[1:])
