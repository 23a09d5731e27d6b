"""Map files: the container, its tables, and the robot that starts with what they hold."""

import struct
import zlib
from collections.abc import Callable

from daemon.maps.container import HEAD, ROW, BadMap
from daemon.maps.image import image_from
from daemon.maps.schema import read, summary
from estimator.stored_map import restored
from tests.daemon.support.map_maker import Shape, content
from tests.fuzz.targets import refused

MEGABYTES = 3


def seeds() -> list[bytes]:
    small = Shape(submaps=3, frames=2, beams=7)
    return [
        content(small),
        content(Shape(submaps=2, frames=2, beams=5, lit=True)),
        content(Shape(submaps=2, frames=1, beams=4, whole=False)),
        content(Shape(submaps=4, frames=1, beams=3, loose=2)),
        content(Shape(submaps=0, frames=0)),
    ]


def mend(data: bytes) -> bytes:
    """All sums and lengths as they should be: what is wrong is then what the numbers say."""
    if len(data) < HEAD.size:
        return data
    magic, version, count, _, _ = HEAD.unpack_from(data)
    end = HEAD.size + count * ROW.size
    if count > 64 or end > len(data):
        return data
    at, rows = end, []
    for name, dtype, columns, number, length, _, packing in ROW.iter_unpack(data[HEAD.size : end]):
        crc = zlib.crc32(data[at : at + length])
        rows.append(ROW.pack(name, dtype, columns, number, length, crc, packing))
        at += length
    table = b"".join(rows)
    head = HEAD.pack(magic, version, count, zlib.crc32(table, version), min(len(data), struct.calcsize("Q") << 58))
    return head + table + data[end:]


def use(data: bytes) -> None:
    stored = read(data)
    assert summary(stored)
    restored(image_from(stored))


def feeder() -> Callable[[bytes], None]:
    def feed(data: bytes) -> None:
        refused(use, data, by=BadMap)

    return feed
