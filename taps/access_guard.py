"""Who may look and who may give orders: the Host and Origin of a request, and the token. Pure: no sockets.

On loopback everybody on this computer may look. Whoever listens on other addresses, or takes orders, has a token; the
page brings it in its first words on the WebSocket, never in an address that ends up in a log. A page of somebody
else's in the same browser is kept out by its Origin, and by the Host that it would have to use.
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
"""Of every answer. Nothing is fetched from outside, nothing inline runs, nobody frames it."""


class TokenRefused(Exception):
    """A token that cannot be used; the text says why and what to do."""


@dataclass(frozen=True, slots=True)
class Guard:
    """The rules of one server.

    Attributes:
        bind: address that is listened on. token: None: there is none. write: whether orders are taken at all.
    """

    bind: str
    token: str | None = None
    write: bool = False

    @property
    def local(self) -> bool:
        """Whether only this computer reaches it."""
        return is_loopback(self.bind)

    @property
    def looks_need_token(self) -> bool:
        """Whether the token is asked of those who only look."""
        return not self.local

    def host_ok(self, host: str) -> bool:
        """Whether a Host header names this computer: a name that somebody else's DNS turned to it does not."""
        name = _name_of(host)
        if name in LOOPBACK or (name and name == self.bind.lower()):
            return True
        if self.local:
            return False
        own = socket.gethostname().lower()
        return _is_address(name) or name in (own, f"{own}.local", own.partition(".")[0])

    def origin_ok(self, origin: str | None, host: str) -> bool:
        """Whether a WebSocket is opened by this page: browsers always say by which; other programs do not."""
        return origin is None or origin.lower() in (f"http://{host.lower()}", f"https://{host.lower()}")

    def token_ok(self, told: object) -> bool:
        """Whether it is the token, in a time that tells nothing."""
        if self.token is None or not isinstance(told, str) or len(told) > LONGEST_TOKEN:
            return False
        return hmac.compare_digest(told.encode(), self.token.encode())

    def may_look(self, told: object) -> bool:
        """Whether one who told this may look."""
        return self.local or self.token_ok(told)

    def may_order(self, told: object) -> bool:
        """Whether one who told this may give orders."""
        return self.write and self.token_ok(told)


def token_for(bind: str, write: bool, file: Path | None) -> str | None:
    """The token to be used: of a file, else a fresh one where one is needed, else None.

    Raises:
        TokenRefused: the file cannot be read, or what it holds is too short to be one.
    """
    if file is None:
        return secrets.token_urlsafe(18) if write or not is_loopback(bind) else None
    try:
        text = file.read_text().strip()
    except (OSError, UnicodeDecodeError) as error:
        raise TokenRefused(f"{file}: the token cannot be read: {error}") from None
    if not SHORTEST_TOKEN <= len(text) <= LONGEST_TOKEN or not text.isascii() or not text.isprintable():
        raise TokenRefused(
            f"{file}: a token is {SHORTEST_TOKEN} to {LONGEST_TOKEN} letters and digits on one line; make one with "
            f"`openssl rand -hex 16 > {file}`"
        )
    if file.stat().st_mode & 0o077:
        raise TokenRefused(f"{file}: others on this computer may read it; `chmod 600 {file}`")
    return text


def is_loopback(bind: str) -> bool:
    """Whether an address to listen on is reached from this computer only."""
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
