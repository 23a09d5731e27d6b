"""Writes an MCAP file of ROS 2 messages (mcap.dev, profile ``ros2``); a killed writer loses at most half a second."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import TracebackType
from typing import IO, Final, Self

from mcap.writer import CompressionType, Writer

from daemon.system.versions import release
from taps.ros import types
from taps.ros.messages import TOPICS, RosMessage

PROFILE: Final = "ros2"
CHUNK_BYTES: Final = 1 << 20
FLUSH_S: Final = 0.25
"""Longest chunk, in the messages' own time; then it is closed and passed to the kernel."""


class NoRoom(Exception):
    """The disk has less free space than the reserve; the text gives both."""


_QOS: Final = """- history: 3
  depth: 0
  reliability: 1
  durability: {durability}
  deadline: {{sec: 9223372036, nsec: 854775807}}
  lifespan: {{sec: 9223372036, nsec: 854775807}}
  liveliness: 1
  liveliness_lease_duration: {{sec: 9223372036, nsec: 854775807}}
  avoid_ros_namespace_conventions: false
"""


class McapFile:
    """An open MCAP file; a context manager.

    Attributes:
        path: of the file. messages: number written. waiting: number of them still in memory.

    Args:
        flush_s: longest time span of buffered messages, s; 0: a whole chunk.
        reserve: bytes that stay free on the disk.

    Raises:
        OSError: the file cannot be written.
        NoRoom: less free space than the reserve; no file was made.
    """

    def __init__(self, path: Path, flush_s: float = FLUSH_S, reserve: int = 0) -> None:
        self.path, self.messages, self.waiting = path, 0, 0
        self._flush_ns = round(1e9 * flush_s)
        self._reserve = reserve
        self._check_reserve()
        self._stream: IO[bytes] = path.open("wb")
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        self._writer.start(PROFILE, f"lumiloop {release()}")
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._begun = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def write(self, out: RosMessage) -> None:
        """Write one message; after `NoRoom` the file can still be closed as a complete one."""
        if (channel := self._channels.get(out.topic)) is None:
            channel = self._channels[out.topic] = self._open(out.topic)
        self._writer.add_message(channel, out.t_ns, out.data, out.t_ns, self.messages & 0xFFFFFFFF)
        self.messages += 1
        self.waiting += 1
        self._begun = out.t_ns if self._begun < 0 else self._begun
        if self._flush_ns and not 0 <= out.t_ns - self._begun < self._flush_ns:
            self.flush()
            self._begun = out.t_ns

    def flush(self) -> None:
        """Close the chunk and pass it to the kernel, so that a killed process loses nothing of it.

        Raises:
            NoRoom: it would use the reserve.
        """
        self._check_reserve()
        # the library closes chunks by size only; a test checks that this name exists
        getattr(self._writer, "_Writer__finalize_chunk")()  # noqa: B009 - a private name of another class
        self._stream.flush()
        self.waiting = 0

    def close(self) -> None:
        """Write the index; idempotent."""
        if not self._stream.closed:
            try:
                self._writer.finish()  # type: ignore[no-untyped-call]  # the mcap library is not typed
            finally:
                self._stream.close()

    def _check_reserve(self) -> None:
        if self._reserve and not _is_device(self.path):
            free = free_bytes(self.path.parent)
            if free < self._reserve:
                raise NoRoom(f"only {free >> 20} MB are free there (--reserve requires {self._reserve >> 20})")

    def _open(self, topic: str) -> int:
        about = TOPICS[topic]
        if about.kind not in self._schemas:
            text = types.definition(about.kind).encode()
            self._schemas[about.kind] = self._writer.register_schema(about.kind, "ros2msg", text)
        # rmw_qos_durability_policy_t: 1 transient local, 2 volatile
        qos = _QOS.format(durability=1 if about.latched else 2)
        return self._writer.register_channel(topic, "cdr", self._schemas[about.kind], {"offered_qos_profiles": qos})


def free_bytes(folder: Path) -> int:
    """Free bytes on the disk of a folder."""
    return shutil.disk_usage(folder).free


def _is_device(path: Path) -> bool:
    """Whether the path is a device, which uses no disk space."""
    return path.exists() and not path.is_file()
