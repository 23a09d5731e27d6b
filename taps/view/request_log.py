"""Log of the HTTP server: a damaged request is the client's fault, counted in one line a minute and never traced."""

from __future__ import annotations

import logging
import time
from typing import Final

from aiohttp.http_exceptions import HttpProcessingError

from daemon.system.logging import Sparing

QUIET_S: Final = 60.0

log = logging.getLogger(__name__)


class ClientFaults(logging.Filter):
    """Filter of a logger: requests that are no HTTP become one line in :data:`QUIET_S`."""

    def __init__(self) -> None:
        super().__init__()
        self._lines = Sparing(log, 1, QUIET_S)

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether the record is logged as it is."""
        error = record.exc_info[1] if record.exc_info else None
        if not isinstance(error, HttpProcessingError | ConnectionError | TimeoutError):
            return True
        self._lines.say(
            time.monotonic(), logging.WARNING, "a client sent data that is not an HTTP request; it was rejected"
        )
        return False


def request_log() -> logging.Logger:
    """The logger for aiohttp's server."""
    logger = logging.getLogger(f"{__name__}.server")
    if not any(isinstance(one, ClientFaults) for one in logger.filters):
        logger.addFilter(ClientFaults())
    return logger
