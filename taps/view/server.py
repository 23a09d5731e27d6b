"""The web server: pages and WebSockets. It takes the stream as one client, however many browsers watch."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from socket import SO_SNDBUF, SOL_SOCKET
from socket import socket as Socket
from typing import Any, Final

from aiohttp import WSCloseCode, WSMsgType, web

from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Hello, NotTheStream, Refused
from taps.access_guard import HEADERS, Guard
from taps.view.orders import OrderRefused, Orders
from taps.view.page_hello import CannotLook, Scene, welcome
from taps.view.replay_file import Film
from taps.view.replay_player import Player
from taps.view.viewers import Hub, Viewer, frame

log = logging.getLogger(__name__)

TOPICS: Final = ("pose", "lights", "scan", "state", "loop", "faults", "statistics", "map")
SUFFIXES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".webmanifest": "application/manifest+json",
}
VIEWERS: Final = 32
STRANGERS: Final = 16
"""Who have not yet said who they are; where more come, the first of them goes. They take no viewer's place."""
FULL: Final = f"{VIEWERS} browsers are watching; close one."
PACE_S: Final = 0.04
"""Least time between two messages to a browser."""
KEPT_BYTES: Final = 64 << 10
"""On their way to one browser."""
HELLO_S: Final = 10.0
"""For the page's first words."""
WRONG_TOKEN_S: Final = 0.5
"""What a wrong token costs; and no more than `GUESSES` at a time."""
GUESSES: Final = 4
LONGEST_WORDS: Final = 4096
HEARTBEAT_S: Final = 10.0
TRY_AGAIN_S: Final = 5.0
MARK: Final = b"@PAGE@"
"""Stands in the page where the number of its version goes."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class View:
    """One web server.

    Args:
        guard: who may look, and who may order. scene: what the stream does not tell.
        stream: of the daemon; None where a ``film`` is shown. modbus: host and port for orders.
        again: reads the scene anew, for each daemon that begins; raises `CannotLook`.
    """

    def __init__(
        self,
        guard: Guard,
        scene: Scene,
        stream: Stream | None = None,
        film: Film | None = None,
        modbus: tuple[str, int] = ("127.0.0.1", 0),
        again: Callable[[], Scene] | None = None,
    ) -> None:
        self.hub = Hub()
        self.page, self._files = pages()
        self._guard, self._scene, self._stream, self._film, self._again = guard, scene, stream, film, again
        self._orders = Orders(*modbus, tell=lambda told: self.hub.tell("order", told), stream=stream)
        self._count = 0
        self._guesses = asyncio.Semaphore(GUESSES)
        self._sockets: set[web.WebSocketResponse] = set()
        self._strangers: deque[web.WebSocketResponse] = deque()

    def app(self) -> web.Application:
        """What aiohttp serves."""
        app = web.Application(middlewares=[self._guarded])
        app.router.add_get("/ws", self._socket)
        app.router.add_get("/{name:[a-z0-9.-]*}", self._file)
        app.cleanup_ctx.append(self._following)
        app.on_shutdown.append(self._part)
        return app

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Host, then what is asked for; every answer carries the headers."""
        if not self._guard.host_ok(request.headers.get("Host", "")):
            text = "This page is not called by that name. Use the address that `lumiloop view` printed.\n"
            return web.Response(status=421, text=text, headers=HEADERS)
        try:
            response = await handler(request)
        except web.HTTPException as error:
            error.headers.update(HEADERS)
            raise
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def _file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info["name"] or "index.html"
        if name not in self._files:
            raise web.HTTPNotFound(text="There is no such file; the page is at /\n")
        tag = f'"{self.page}"'
        if request.headers.get("If-None-Match") == tag:
            return web.Response(status=304, headers={"ETag": tag})
        kind = SUFFIXES[Path(name).suffix]
        return web.Response(body=self._files[name], headers={"Content-Type": kind, "ETag": tag})

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if not self._guard.origin_ok(request.headers.get("Origin"), request.headers.get("Host", "")):
            raise web.HTTPForbidden(text="Only the page of this server may open this.\n")
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, max_msg_size=LONGEST_WORDS, compress=False)
        await socket.prepare(request)
        _little_kept(request)
        try:
            if (viewer := await self._greeted(socket)) is not None:
                await self._serve(socket, viewer)
        except ConnectionResetError:
            pass  # the page was closed while something was being sent to it
        finally:
            self._sockets.discard(socket)
        return socket

    async def _greeted(self, socket: web.WebSocketResponse) -> Viewer | None:
        """A viewer, which has a place now; None: it was refused, and told why."""
        if len(self._strangers) >= STRANGERS:
            await _refuse(self._strangers.popleft(), "words", "Others came before it said who it is.")
        self._strangers.append(socket)
        try:
            return await self._known(socket)
        finally:
            with contextlib.suppress(ValueError):  # it has gone for others
                self._strangers.remove(socket)

    async def _known(self, socket: web.WebSocketResponse) -> Viewer | None:
        """A viewer, after its first words."""
        words = await _words(socket, HELLO_S)
        token = None if words is None else words.get("token")
        if words is None:
            await _refuse(socket, "words", "A page says first who it is.")
            return None
        if token is not None and not self._guard.token_ok(token):
            async with self._guesses:
                await asyncio.sleep(WRONG_TOKEN_S)
        if not self._guard.may_look(token):
            await _refuse(socket, "token", "This page is shown to those who have its token.")
            return None
        if len(self._sockets) >= VIEWERS:
            await _refuse(socket, "full", FULL)
            return None
        self._sockets.add(socket)
        self._count += 1
        viewer = Viewer(self._count, self._guard.may_order(token) and self._film is None)
        recording = None if self._film is None else self._film.source
        told = welcome(self._scene, self.page, viewer.order, recording)
        told |= {"you": viewer.number, "wrong_token": token is not None and not self._guard.token_ok(token)}
        await socket.send_json({"kind": "welcome", **told})
        return viewer

    async def _serve(self, socket: web.WebSocketResponse, viewer: Viewer) -> None:
        player = None if self._film is None else Player(self._film, viewer)
        if player is None:
            self.hub.welcome(viewer)
        tasks = [asyncio.create_task(_or_part(socket, _send(socket, viewer)))]
        if player is not None:
            tasks.append(asyncio.create_task(_or_part(socket, player.run())))
        try:
            while (words := await _words(socket)) is not None:
                if player is not None and "play" in words:
                    player.told(words["play"])
                elif "ping" in words:
                    await socket.send_json({"kind": "pong", "ping": words["ping"], "utc": time.time()})
                elif "order" in words:
                    await self._order(viewer, words)
        finally:
            self.hub.viewers.discard(viewer)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _order(self, viewer: Viewer, words: dict[str, Any]) -> None:
        try:
            if not viewer.order:
                raise OrderRefused("this page may only look: start `lumiloop view --write` and use the address it says")
            await self._orders.give(viewer.number, words)
        except OrderRefused as error:
            told = {"order": str(words.get("order"))[:40], "viewer": viewer.number, "outcome": str(error)}
            viewer.put("order", frame("order", told), once=True)

    async def _following(self, app: web.Application) -> AsyncIterator[None]:
        """Follows the stream while the server runs."""
        following = None if self._stream is None else asyncio.create_task(self._follow(self._stream))
        yield
        await self._orders.close()
        if following is not None:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)

    async def _follow(self, stream: Stream) -> None:
        while True:
            try:
                async for told in stream.frames():
                    if isinstance(told, Hello):
                        self.hub.met()
                        self._look_again()
                    elif isinstance(told, Lost):
                        self.hub.lost(told.text)
                        log.warning("%s", told.text)
                    elif not isinstance(told, Refused):
                        self.hub.take(told)
            except NotTheStream as error:
                self.hub.lost(str(error))
                log.error("%s", error)
            except Exception:  # a defect of ours: the page says so and goes on, with all that comes after it
                self.hub.lost("what the daemon told could not be shown; the log of `lumiloop view` says why")
                log.exception("what the daemon told could not be shown")
            await asyncio.sleep(TRY_AGAIN_S)

    def _look_again(self) -> None:
        """A daemon has begun, perhaps with another survey or mount: pages draw what it has read."""
        try:
            scene = self._scene if self._again is None else self._again()
        except CannotLook as error:
            log.warning("lamps and mount are shown as they were before: %s", error)
            return
        if scene != self._scene:
            self._scene = scene
            self.hub.tell("scene", asdict(scene))

    async def _part(self, app: web.Application) -> None:
        """The server stops: pages are told, and look whether another one comes."""
        for socket in [*self._sockets, *self._strangers]:
            with contextlib.suppress(ConnectionError, RuntimeError):
                await socket.close(code=WSCloseCode.GOING_AWAY, message=b"the view stops")


def pages() -> tuple[str, dict[str, bytes]]:
    """What is served: the number of this version of the page, and its files by name."""
    folder = resources.files("taps.view").joinpath("page")
    files = {entry.name: entry.read_bytes() for entry in folder.iterdir() if Path(entry.name).suffix in SUFFIXES}
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(name.encode() + b"\0" + files[name])
    page = digest.hexdigest()[:16]
    files["index.html"] = files["index.html"].replace(MARK, page.encode())
    return page, files


def _little_kept(request: web.Request) -> None:
    """What the kernel keeps for a browser that is slow is old when it arrives: let that be little."""
    transport = request.transport
    if transport is not None:
        transport.set_write_buffer_limits(high=KEPT_BYTES)
        sock: Socket | None = transport.get_extra_info("socket")
        if sock is not None:
            sock.setsockopt(SOL_SOCKET, SO_SNDBUF, KEPT_BYTES)


async def _or_part(socket: web.WebSocketResponse, work: Coroutine[Any, Any, None]) -> None:
    """Work for a browser; where it fails the connection ends, and the page comes again by itself."""
    try:
        await work
    except ConnectionError:
        log.debug("a browser has gone", exc_info=True)
    except Exception:  # a defect of ours
        log.exception("a browser could not be told what it should see")
        with contextlib.suppress(ConnectionError, RuntimeError):
            await socket.close(code=WSCloseCode.INTERNAL_ERROR, message=b"the log of `lumiloop view` says why")


async def _send(socket: web.WebSocketResponse, viewer: Viewer) -> None:
    """Send what waits, as fast as the browser takes it, but not faster than it can be seen."""
    while True:
        await viewer.some.wait()
        message = viewer.take()
        if message is not None:
            await socket.send_bytes(message)
        await asyncio.sleep(PACE_S)


async def _words(socket: web.WebSocketResponse, patience_s: float | None = None) -> dict[str, Any] | None:
    """What the page says next; None: it has gone, or talks nonsense."""
    try:
        async with asyncio.timeout(patience_s):
            message = await socket.receive()
    except TimeoutError:
        return None
    if message.type is not WSMsgType.TEXT:
        return None
    try:
        words = json.loads(message.data, parse_int=float)  # beyond all floats: infinite, and no error later
        json.dumps(words, ensure_ascii=False).encode()  # half a surrogate pair is no text
    except (ValueError, RecursionError):
        return None
    return words if isinstance(words, dict) else None


async def _refuse(socket: web.WebSocketResponse, what: str, text: str) -> None:
    with contextlib.suppress(ConnectionError):
        await socket.send_json({"kind": "refused", "what": what, "text": text})
        await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=what.encode())
