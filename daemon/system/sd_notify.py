"""Service manager notification (sd_notify(3)): datagrams to ``$NOTIFY_SOCKET``; without it nothing is sent."""

from __future__ import annotations

import os
import socket


def managed() -> bool:
    """Whether a service manager started this process and expects notifications."""
    return os.environ.get("NOTIFY_SOCKET", "").startswith(("/", "@"))


def notify(*words: str) -> None:
    """Send a notification, e.g. ``READY=1``, to the service manager; without one, do nothing."""
    if not managed():
        return
    address = os.environ["NOTIFY_SOCKET"]
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as sock:
            sock.sendto("\n".join(words).encode(), address.replace("@", "\0", 1))
    except OSError:
        return  # the manager restarts, its queue is full, or no file descriptor is left: the next notification will do
