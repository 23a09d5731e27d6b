"""The web server: pages and WebSockets. It is a single client of the stream, for any number of browsers."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import asdict
from importlib import resources
from pathlib import Path
from socket import SO_SNDBUF, SOL_SOCKET
from socket import socket as Socket
from typing import Any, Final

from aiohttp import WSCloseCode, WSMsgType, web

from daemon.publish.modbus.command_client import CommandRefused
from daemon.publish.stream.client import Lost, Stream
from daemon.publish.stream.messages import Hello, NotTheStream, Refused
from hal.net.peers import full_for, host_of, largest, most_of
from taps.access_guard import HEADERS, Guard
from taps.view.orders import Orders
from taps.view.page_hello import Scene, SceneUnreadable, welcome
from taps.view.replay_file import ReplayFile
from taps.view.replay_player import ReplayPlayer
from taps.view.request_log import request_log
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
UNAUTHENTICATED: Final = 16
"""Most connections before authentication; they do not count as viewers. A further one replaces the oldest one of the
host that has most of them."""
FULL: Final = f"{VIEWERS} browsers are connected, or {most_of(VIEWERS)} from one computer; close one."
PACE_S: Final = 0.04
"""Least time between two messages to a browser."""
KEPT_BYTES: Final = 64 << 10
"""Bytes buffered for one browser."""
HELLO_S: Final = 10.0
"""Time limit of the page's first message."""
WRONG_TOKEN_S: Final = 0.5
"""Delay after a wrong token; at most `GUESSES` are checked at a time."""
GUESSES: Final = 4
LONGEST_MESSAGE: Final = 4096
HEARTBEAT_S: Final = 10.0
TRY_AGAIN_S: Final = 5.0
MARK: Final = b"@PAGE@"
"""Placeholder in the page for its version."""

Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class View:
    """One web server.

    Args:
        guard: access control. scene: data that the stream does not carry.
        stream: of the daemon; None where a ``film`` is shown. modbus: host and port for commands.
        again: reloads the scene, for each started daemon; raises `SceneUnreadable`.
    """

    def __init__(
        self,
        guard: Guard,
        scene: Scene,
        stream: Stream | None = None,
        film: ReplayFile | None = None,
        modbus: tuple[str, int] = ("127.0.0.1", 0),
        again: Callable[[], Scene] | None = None,
    ) -> None:
        self.hub = Hub()
        self.page, self._files = pages()
        self._guard, self._scene, self._stream, self._film, self._again = guard, scene, stream, film, again
        self._orders = Orders(*modbus, notify=lambda order: self.hub.broadcast("order", order), stream=stream)
        self._count = 0
        self._guesses = asyncio.Semaphore(GUESSES)
        self._sockets: dict[web.WebSocketResponse, str] = {}
        self._unauthenticated: dict[web.WebSocketResponse, str] = {}

    def app(self) -> web.Application:
        """The aiohttp application."""
        app = web.Application(middlewares=[self._guarded])
        app.router.add_get("/ws", self._socket)
        app.router.add_get("/{name:[a-z0-9.-]*}", self._file)
        app.cleanup_ctx.append(self._following)
        app.on_shutdown.append(self._close_all)
        return app

    def runner(self, shutdown_s: float = 1.0) -> web.AppRunner:
        """The application's runner; at its end connections have ``shutdown_s`` to close."""
        return web.AppRunner(self.app(), access_log=None, logger=request_log(), shutdown_timeout=shutdown_s)

    @web.middleware
    async def _guarded(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Check the Host header, handle the request, and add the security headers."""
        if not self._guard.host_ok(request.headers.get("Host", "")):
            text = "This page has another address. Use the address that `lumiloop view` printed.\n"
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
            raise web.HTTPNotFound(text="No such file. The page is at /\n")
        tag = f'"{self.page}"'
        if request.headers.get("If-None-Match") == tag:
            return web.Response(status=304, headers={"ETag": tag})
        kind = SUFFIXES[Path(name).suffix]
        return web.Response(body=self._files[name], headers={"Content-Type": kind, "ETag": tag})

    async def _socket(self, request: web.Request) -> web.StreamResponse:
        if not self._guard.origin_ok(request.headers.get("Origin"), request.headers.get("Host", "")):
            raise web.HTTPForbidden(text="Only the page of this server can open this.\n")
        socket = web.WebSocketResponse(heartbeat=HEARTBEAT_S, max_msg_size=LONGEST_MESSAGE, compress=False)
        await socket.prepare(request)
        _limit_buffers(request)
        try:
            if (viewer := await self._admit(socket, request.remote or "")) is not None:
                await self._serve(socket, viewer)
        except ConnectionResetError:
            pass  # the page was closed during a transmission
        finally:
            self._sockets.pop(socket, None)
        return socket

    async def _admit(self, socket: web.WebSocketResponse, host: str) -> Viewer | None:
        """Admit a connection as a viewer; None: it was refused, with a reason."""
        waiting = self._unauthenticated
        if len(waiting) >= UNAUTHENTICATED:
            most = largest(waiting.values())
            oldest = next(one for one, peer in waiting.items() if host_of(peer) == most)
            del waiting[oldest]
            await _refuse(oldest, "words", "Too many pages connected before this one sent its token.")
        waiting[socket] = host
        try:
            return await self._authenticate(socket, host)
        finally:
            waiting.pop(socket, None)  # it may have been replaced by another one

    async def _authenticate(self, socket: web.WebSocketResponse, host: str) -> Viewer | None:
        """Authenticate a connection by its first message."""
        message = await _receive_json(socket, HELLO_S)
        token = None if message is None else message.get("token")
        if message is None:
            await _refuse(socket, "words", "The page must first send its token.")
            return None
        if token is not None and not self._guard.token_ok(token):
            async with self._guesses:
                await asyncio.sleep(WRONG_TOKEN_S)
        if not self._guard.may_watch(token):
            await _refuse(socket, "token", "This page needs its token.")
            return None
        if len(self._sockets) >= VIEWERS or full_for(host, self._sockets.values(), VIEWERS):
            await _refuse(socket, "full", FULL)
            return None
        self._sockets[socket] = host
        self._count += 1
        viewer = Viewer(self._count, self._guard.may_command(token) and self._film is None)
        recording = None if self._film is None else self._film.source
        item = welcome(self._scene, self.page, viewer.order, recording)
        item |= {"you": viewer.number, "wrong_token": token is not None and not self._guard.token_ok(token)}
        await socket.send_json({"kind": "welcome", **item})
        return viewer

    async def _serve(self, socket: web.WebSocketResponse, viewer: Viewer) -> None:
        player = None if self._film is None else ReplayPlayer(self._film, viewer)
        if player is None:
            self.hub.welcome(viewer)
        tasks = [asyncio.create_task(_close_on_error(socket, _send(socket, viewer)))]
        if player is not None:
            tasks.append(asyncio.create_task(_close_on_error(socket, player.run())))
        try:
            while (message := await _receive_json(socket)) is not None:
                if player is not None and "play" in message:
                    player.control(message["play"])
                elif "ping" in message:
                    await socket.send_json({"kind": "pong", "ping": message["ping"], "utc": time.time()})
                elif "order" in message:
                    await self._order(viewer, message)
        finally:
            self.hub.viewers.discard(viewer)
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)

    async def _order(self, viewer: Viewer, message: dict[str, Any]) -> None:
        try:
            if not viewer.order:
                raise CommandRefused(
                    "this page is read-only: start `lumiloop view --write` and open the address that it prints"
                )
            await self._orders.give(viewer.number, message)
        except CommandRefused as error:
            item = {"order": str(message.get("order"))[:40], "viewer": viewer.number, "outcome": str(error)}
            viewer.put("order", frame("order", item), once=True)

    async def _following(self, app: web.Application) -> AsyncIterator[None]:
        """Read the stream while the server runs."""
        following = None if self._stream is None else asyncio.create_task(self._follow(self._stream))
        yield
        await self._orders.close()
        if following is not None:
            following.cancel()
            await asyncio.gather(following, return_exceptions=True)

    async def _follow(self, stream: Stream) -> None:
        while True:
            try:
                async for item in stream.frames():
                    if isinstance(item, Hello):
                        self.hub.connected()
                        self._reload_scene()
                    elif isinstance(item, Lost):
                        self.hub.disconnected(item.text)
                        log.warning("%s", item.text)
                    elif not isinstance(item, Refused):
                        self.hub.distribute(item)
            except NotTheStream as error:
                self.hub.disconnected(str(error))
                log.error("%s", error)
            except Exception:  # an internal error: the page shows it and continues
                self.hub.disconnected("an internal error of the page's server; see the log of `lumiloop view`")
                log.exception("the data of the daemon could not be shown")
            await asyncio.sleep(TRY_AGAIN_S)

    def _reload_scene(self) -> None:
        """Reload the scene for a started daemon, whose survey or mount may have changed."""
        try:
            scene = self._scene if self._again is None else self._again()
        except SceneUnreadable as error:
            log.warning("the previous lamps and mount are shown: %s", error)
            return
        if scene != self._scene:
            self._scene = scene
            self.hub.broadcast("scene", asdict(scene))

    async def _close_all(self, app: web.Application) -> None:
        """Close all connections at the server's end; the pages then try to reconnect."""
        for socket in [*self._sockets, *self._unauthenticated]:
            with contextlib.suppress(ConnectionError, RuntimeError):
                await socket.close(code=WSCloseCode.GOING_AWAY, message=b"the view stops")


def pages() -> tuple[str, dict[str, bytes]]:
    """The version of the page (a hash), and its files by name."""
    folder = resources.files("taps.view").joinpath("page")
    files = {entry.name: entry.read_bytes() for entry in folder.iterdir() if Path(entry.name).suffix in SUFFIXES}
    digest = hashlib.sha256()
    for name in sorted(files):
        digest.update(name.encode() + b"\0" + files[name])
    page = digest.hexdigest()[:16]
    files["index.html"] = files["index.html"].replace(MARK, page.encode())
    return page, files


def _limit_buffers(request: web.Request) -> None:
    """Limit the send buffers, so that a slow browser receives recent data."""
    transport = request.transport
    if transport is not None:
        transport.set_write_buffer_limits(high=KEPT_BYTES)
        sock: Socket | None = transport.get_extra_info("socket")
        if sock is not None:
            sock.setsockopt(SOL_SOCKET, SO_SNDBUF, KEPT_BYTES)


async def _close_on_error(socket: web.WebSocketResponse, work: Coroutine[Any, Any, None]) -> None:
    """Run work for a browser; a failure closes the connection, and the page reconnects."""
    try:
        await work
    except ConnectionError:
        log.debug("a browser has disconnected", exc_info=True)
    except Exception:  # an internal error
        log.exception("sending to a browser has failed")
        with contextlib.suppress(ConnectionError, RuntimeError):
            await socket.close(code=WSCloseCode.INTERNAL_ERROR, message=b"the log of `lumiloop view` says why")


async def _send(socket: web.WebSocketResponse, viewer: Viewer) -> None:
    """Send queued messages as fast as the browser accepts them, at most every :data:`PACE_S`."""
    while True:
        await viewer.pending.wait()
        message = viewer.next_message()
        if message is not None:
            await socket.send_bytes(message)
        await asyncio.sleep(PACE_S)


async def _receive_json(socket: web.WebSocketResponse, patience_s: float | None = None) -> dict[str, Any] | None:
    """The page's next message; None: it has disconnected, or sent something invalid."""
    try:
        async with asyncio.timeout(patience_s):
            message = await socket.receive()
    except TimeoutError:
        return None
    if message.type is not WSMsgType.TEXT:
        return None
    try:
        message = json.loads(message.data, parse_int=float)  # huge integers become infinite instead of an error later
        json.dumps(message, ensure_ascii=False).encode()  # rejects lone surrogates
    except (ValueError, RecursionError):
        return None
    return message if isinstance(message, dict) else None


async def _refuse(socket: web.WebSocketResponse, what: str, text: str) -> None:
    with contextlib.suppress(ConnectionError):
        await socket.send_json({"kind": "refused", "what": what, "text": text})
        await socket.close(code=WSCloseCode.POLICY_VIOLATION, message=what.encode())
