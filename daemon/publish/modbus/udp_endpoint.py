"""Modbus over UDP: one datagram is one request, and nothing is stored between datagrams."""

from __future__ import annotations

import socket
from collections.abc import Callable
from typing import Final

from daemon.publish.modbus.counts import STRANGE, Allowed, Counts, everyone
from daemon.publish.modbus.requests import MAX_FRAME, Responder, frame_size
from hal.net.fair_share import Reader, Share
from hal.net.reply_address import PACKET_INFO_SPACE, ReplySource, enable_packet_info, reply_source, send_from
from hal.net.rx_timestamp import STAMP_SPACE, enable_rx_timestamps, kernel_age

UDP_PER_TURN: Final = 8


class UdpEndpoint:
    """Serves one bound datagram socket."""

    def __init__(
        self,
        sock: socket.socket,
        responder: Responder,
        counts: Counts,
        allowed: Allowed = everyone,
        share: Share | None = None,
        on_age: Callable[[float], None] | None = None,
    ) -> None:
        """``on_age``: receives before each request its age since the kernel received it (s), and 0 after the last."""
        self._sock = sock
        self._on_age = on_age
        self._space = 0  # size of the kernel's ancillary data of a datagram
        if on_age is not None:
            enable_rx_timestamps(sock)
            self._space += STAMP_SPACE
        if enable_packet_info(sock):
            self._space += PACKET_INFO_SPACE
        self._allowed = allowed
        self._responder = responder
        self._counts = counts
        self._reader = Reader(sock.fileno(), self._serve, share or Share())

    def close(self) -> None:
        """Stop serving and close the socket."""
        self._reader.close()
        self._sock.close()

    def _serve(self) -> None:
        try:
            self._serve_some()
        finally:
            if self._on_age is not None:
                self._on_age(0.0)

    def _serve_some(self) -> None:
        for _ in range(UDP_PER_TURN):
            source: ReplySource = ()
            try:
                if self._space:
                    frame, told, _, peer = self._sock.recvmsg(MAX_FRAME + 1, self._space)
                    source = reply_source(told)
                    if self._on_age is not None:
                        self._on_age(kernel_age(told))
                else:
                    frame, peer = self._sock.recvfrom(MAX_FRAME + 1)
            except OSError:  # no more data, or a network error caused by an earlier reply
                return
            if not self._allowed(peer[0]):
                continue
            if not frame or frame_size(frame) != len(frame):
                self._counts.malformed += 1
                self._counts.tell(peer[0], STRANGE)
                continue
            self._counts.requests += 1
            answer = self._responder.answer(frame)
            try:
                send_from(self._sock, answer, source, peer)
            except OSError:
                self._counts.unsent += 1
