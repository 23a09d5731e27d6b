"""`lumiloop metrics`: an HTTP server of Prometheus metrics and the VDA 5050 position, on loopback by default.

A minimal server: two documents, built on request, one request per connection.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import logging
import time
from typing import Final

from daemon.config.endpoints import in_url, parse_endpoint
from daemon.publish.stream.client import Stream
from daemon.publish.stream.messages import NotTheStream
from daemon.system import console
from daemon.system.defects import Place, log_once
from daemon.system.logging import start_command_log
from hal.net.peers import full_for
from hal.run_server import run_until_stopped
from taps.access_guard import Guard
from taps.metrics import vda5050
from taps.metrics.metrics import CONTENT_TYPE, Latest, exposition

log = logging.getLogger(__name__)

LONGEST_REQUEST: Final = 8192
PATIENCE_S: Final = 5.0
CLIENTS: Final = 32
TOPICS: Final = ("pose", "lights", "faults", "statistics")
_JSON: Final = "application/json"
_REASONS: Final = {
    200: "OK",
    400: "Bad Request",
    403: "Forbidden",
    404: "Not Found",
    405: "Method Not Allowed",
    503: "Service Unavailable",
}
INDEX: Final = "/metrics: Prometheus\n/vda5050: position, version 3\n/vda5050/2: position, version 2\n"


def main(args: argparse.Namespace) -> int:
    """The command's body; returns the exit code."""
    start_command_log()
    try:
        host, port = parse_endpoint(args.listen)
        stream = Stream(args.stream or args.settings.name, TOPICS)
        asyncio.run(run_until_stopped(serve(stream, host, port)))
    except ValueError as error:
        return console.fail(f"--listen: {error}", console.USAGE)
    except NotTheStream as error:
        return console.fail(str(error))
    except OSError as error:
        return console.fail(
            f"cannot listen on {args.listen}: {error.strerror}; free the address, or name another with --listen"
        )
    return console.OK


async def serve(stream: Stream, host: str, port: int) -> None:
    """Read the stream and answer requests until cancelled.

    Raises:
        OSError: the address cannot be used. NotTheStream: the other end is no daemon of this version.
    """
    messages = Latest()
    handler = HttpHandler(messages, Guard(bind=host))
    server = await asyncio.start_server(handler, host, port, limit=LONGEST_REQUEST)
    console.say(f"http://{in_url(host)}:{server.sockets[0].getsockname()[1]}/metrics")
    try:
        async with contextlib.aclosing(stream.frames()) as frames:
            async for frame in frames:
                messages.update(frame, time.monotonic())
    finally:
        server.close()


class HttpHandler:
    """Answers HTTP requests from the latest messages; rejects requests that a foreign web page makes a browser send."""

    def __init__(self, messages: Latest, guard: Guard) -> None:
        self._messages, self._guard = messages, guard
        self._peers: list[str] = []
        self._defects: set[Place] = set()

    async def __call__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one request; a slow client, and one above the limit or its host's share, is disconnected."""
        peer = str((writer.get_extra_info("peername") or ("",))[0])
        refused = len(self._peers) >= CLIENTS or full_for(peer, self._peers, CLIENTS)
        self._peers.append(peer)
        try:
            if not refused:
                async with asyncio.timeout(PATIENCE_S):
                    request = await reader.readuntil(b"\r\n\r\n")
                    writer.write(self._answer(request))
                    await writer.drain()
        except (TimeoutError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, OSError):
            return
        except Exception as error:  # noqa: BLE001  any failure ends this connection alone
            log_once(log, self._defects, error, "serving a request has failed; its connection is closed")
        finally:
            self._peers.remove(peer)
            writer.close()

    def _answer(self, request: bytes) -> bytes:
        words = request.partition(b"\r\n")[0].decode("latin-1").split(" ")
        if len(words) != 3 or not words[2].startswith("HTTP/1."):
            return _response(400, "text/plain", "not an HTTP/1 request\n")
        if not self._host_allowed(request):
            return _response(403, "text/plain", "the request names another host; use this computer's address\n")
        method, path = words[0], words[1].partition("?")[0]
        if method not in ("GET", "HEAD"):
            return _response(405, "text/plain", "only GET is possible\n")
        status, kind, body = self._document(path)
        return _response(status, kind, body, head=method == "HEAD")

    def _host_allowed(self, request: bytes) -> bool:
        """Check the Host header: browsers always send one, other programs need not."""
        named = [line.partition(b":")[2] for line in request.split(b"\r\n")[1:] if line.lower().startswith(b"host:")]
        return all(not self._guard.local or self._guard.host_ok(one.decode("latin-1").strip()) for one in named)

    def _document(self, path: str) -> tuple[int, str, str]:
        messages = self._messages
        match path:
            case "/metrics":
                return 200, CONTENT_TYPE, exposition(messages, time.monotonic())
            case "/vda5050" | "/vda5050/2":
                second = path.endswith("2")
                make = vda5050.position_v2 if second else vda5050.position
                latest = messages.latest(time.monotonic())
                made = None if latest is None else make(latest, messages.held)
                if made is None:
                    why = "the daemon does not answer" if not messages.up else "no pose is available yet"
                    return 503, _JSON, json.dumps({"error": why}) + "\n"
                return 200, _JSON, json.dumps({"agvPosition" if second else "mobileRobotPosition": made}) + "\n"
            case "/":
                return 200, "text/plain", INDEX
        return 404, "text/plain", INDEX


def _response(status: int, kind: str, body: str, head: bool = False) -> bytes:
    content = body.encode()
    lines = (
        f"HTTP/1.1 {status} {_REASONS[status]}",
        f"Content-Type: {kind}",
        f"Content-Length: {len(content)}",
        "Cache-Control: no-store",
        "Connection: close",
    )
    return "\r\n".join(lines).encode() + b"\r\n\r\n" + (b"" if head else content)
