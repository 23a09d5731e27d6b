"""Recovers truncated MCAP files: copies their intact messages into a complete file with an index.

A file whose writer was killed has no index, and many tools refuse it. Its chunks are intact up to the last one written.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Final

from mcap.exceptions import EndOfFile, McapError
from mcap.records import Channel, Footer, Header, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import Writer
from zstandard import ZstdError

MAGIC: Final = b"\x89MCAP0\r\n"
LONGEST: Final = 256 << 20
"""Most bytes of a record; a longer one is damage."""


CUT: Final = "its writer still runs or was killed, or the disk was full"
"""Possible causes of a file without an end."""


class NotMcap(Exception):
    """Not an MCAP file, or nothing of it is readable; the text gives the cause and a remedy."""


@dataclass(slots=True)
class Recovered:
    """The result: messages, time span (ns), and why the file ended early; empty: it was complete."""

    messages: int = 0
    first_ns: int = 0
    last_ns: int = 0
    torn: str = ""

    def sentence(self) -> str:
        """The result as text."""
        span = (self.last_ns - self.first_ns) * 1e-9
        ended = "the file was complete" if not self.torn else f"the file ends there: {self.torn}"
        return f"{self.messages} messages over {span:.1f} s; {ended}"


def recover(source: Path, target: Path) -> Recovered:
    """Copy all intact messages, with an index.

    Raises:
        NotMcap: no intact message.
        OSError: a file cannot be read or written.
    """
    found = Recovered()
    with source.open("rb") as data:
        if data.read(len(MAGIC)) != MAGIC:
            raise NotMcap(f"{source} is not an MCAP file; its first bytes are wrong")
        data.seek(0)
        temporary = target.with_name(f".{target.name}.part")
        try:
            with temporary.open("wb") as out:
                _copy(data, out, found)
            if not found.messages:
                raise NotMcap(
                    f"{source} has no complete message: {found.torn or 'it is empty'}; nothing can be recovered"
                )
            temporary.replace(target)
        finally:
            temporary.unlink(missing_ok=True)
    return found


def _copy(data: IO[bytes], out: IO[bytes], found: Recovered) -> None:
    writer = Writer(out)
    schemas: dict[int, int] = {0: 0}
    channels: dict[int, int] = {}
    begun = False
    for record in _intact(data, found):
        if isinstance(record, Header) and not begun:
            writer.start(record.profile, record.library)
            begun = True
        elif isinstance(record, Schema) and record.id not in schemas:
            schemas[record.id] = writer.register_schema(record.name, record.encoding, record.data)
        elif isinstance(record, Channel) and record.id not in channels and record.schema_id in schemas:
            channels[record.id] = writer.register_channel(
                record.topic, record.message_encoding, schemas[record.schema_id], record.metadata
            )
        elif isinstance(record, Message) and record.channel_id in channels:
            writer.add_message(
                channels[record.channel_id], record.log_time, record.data, record.publish_time, record.sequence
            )
            found.first_ns = min(found.first_ns, record.log_time) if found.messages else record.log_time
            found.last_ns = max(found.last_ns, record.log_time)
            found.messages += 1
    writer.finish()  # type: ignore[no-untyped-call]  # the mcap library is not typed


def _intact(data: IO[bytes], found: Recovered) -> Iterator[McapRecord]:
    """Intact records, up to the end or the first damage."""
    records = StreamReader(data, validate_crcs=True, record_size_limit=LONGEST).records
    ended = False
    while True:
        try:
            record = next(records)
        except StopIteration:
            return
        except EndOfFile:
            found.torn = "" if ended else f"it is cut at byte {data.tell()}, {CUT}"
            return
        except (McapError, ZstdError, struct.error, ValueError, RuntimeError) as error:
            found.torn = f"it is damaged before byte {data.tell()} ({error})"
            return
        ended = ended or isinstance(record, Footer)
        yield record
