"""Access control of the web servers: Host and Origin of a request, and the token. Pure: no sockets.

On loopback every user of this computer may watch. A server on other addresses, or one that accepts commands, requires a
token. The page sends it in its first WebSocket message, never in a URL that reaches a log. Pages of other sites in the
same browser are rejected by their Origin, and by the Host that they would have to use.
"""

from __future__ import annotations

import hmac
import ipaddress
import secrets
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Final

LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
SHORTEST_TOKEN: Final = 16
LONGEST_TOKEN: Final = 256

CSP: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
    "manifest-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
HEADERS: Final = {
    "Content-Security-Policy": CSP,
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-cache",
}
"""Headers of every response: no external resources, no inline scripts, no framing."""


class TokenRefused(Exception):
    """An unusable token; the text gives the cause and a remedy."""


@dataclass(frozen=True, slots=True)
class Guard:
    """The rules of one server.

    Attributes:
        bind: listening address. token: None: none is required. write: whether commands are accepted.
    """

    bind: str
    token: str | None = None
    write: bool = False

    @property
    def local(self) -> bool:
        """Whether only this computer can connect."""
        return is_loopback(self.bind)

    @property
    def watching_needs_token(self) -> bool:
        """Whether watching requires the token."""
        return not self.local

    def host_ok(self, host: str) -> bool:
        """Whether a Host header names this computer (against DNS rebinding)."""
        name = _name_of(host)
        if name in LOOPBACK or (name and name == self.bind.lower()):
            return True
        if self.local:
            return False
        own = socket.gethostname().lower()
        return _is_address(name) or name in (own, f"{own}.local", own.partition(".")[0])

    def origin_ok(self, origin: str | None, host: str) -> bool:
        """Whether a WebSocket was opened by this page: browsers always send an Origin, other programs do not."""
        return origin is None or origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")

    def token_ok(self, token: object) -> bool:
        """Compare a token in constant time."""
        if self.token is None or not isinstance(token, str) or len(token) > LONGEST_TOKEN:
            return False
        return hmac.compare_digest(token.encode(), self.token.encode())

    def may_watch(self, token: object) -> bool:
        """Whether this token permits watching."""
        return self.local or self.token_ok(token)

    def may_command(self, token: object) -> bool:
        """Whether this token permits commands."""
        return self.write and self.token_ok(token)


def token_for(bind: str, write: bool, file: Path | None) -> str | None:
    """The token of a file, else a random one where one is required, else None.

    Raises:
        TokenRefused: the file cannot be read, or its content is no valid token.
    """
    if file is None:
        return secrets.token_urlsafe(18) if write or not is_loopback(bind) else None
    try:
        text = file.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise TokenRefused(f"{file}: cannot read the token: {error}") from None
    if not SHORTEST_TOKEN <= len(text) <= LONGEST_TOKEN or not text.isascii() or not text.isprintable():
        raise TokenRefused(
            f"{file}: not a token of {SHORTEST_TOKEN} to {LONGEST_TOKEN} letters and digits on one line; make "
            f"one with `openssl rand -hex 16 > {file}`"
        )
    if file.stat().st_mode & 0o077:
        raise TokenRefused(f"{file}: other users of this computer can read the file; run `chmod 600 {file}`")
    return text


def is_loopback(bind: str) -> bool:
    """Whether a listening address can be reached from this computer only."""
    try:
        return bind == "localhost" or ipaddress.ip_address(bind).is_loopback
    except ValueError:
        return False


def _name_of(host: str) -> str:
    """A Host header without its port."""
    host = host.strip().lower()
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.rpartition(":")[0] if host.count(":") == 1 else host


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True
