"""Memory in large pages: what the daemon holds when its cycles begin, gathered once into pages of 2 MB.

A cycle touches a little of very much: objects, code and arrays all over some 100 MB, 40 times a second, and between two
cycles other programs have the caches. With pages of 4 kB the processor then looks most of its addresses up anew, in a
virtual machine along two tables; with large ones a few entries hold them all.

It is done once and is no advice for what comes later: a map that grew by 2 MB at a time could not be told from a leak.
"""

from __future__ import annotations

import ctypes
import os
import re
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

MADV_COLLAPSE: Final = 25
"""Of madvise(2), since Linux 6.1: put these pages into large ones now, whatever the system's setting is."""
LONGEST_S: Final = 0.5
"""No more time for it than this: a kernel without large pages at hand has to make them by moving others."""
MOST_OF: Final = 0.75
"""Part of a piece that has to be there already: the rest of it becomes resident, too."""
_PRESENT: Final = 1 << 7
"""In the last byte of a page's entry in pagemap (proc(5)): it is in memory."""
_LINE: Final = re.compile(r"([0-9a-f]+)-([0-9a-f]+) rw.p \S+ \S+ 0 *(\[heap\]|\[anon.*\])?$")
_SIZE: Final = Path("/sys/kernel/mm/transparent_hugepage/hpage_pmd_size")


def gather(longest_s: float = LONGEST_S) -> str:
    """Put what is in memory and private to the process into large pages; what was done, or why not, as a phrase.

    Needs no right. Takes some 0.2 s for 100 MB beside other programs, at most ``longest_s`` and one piece more.
    """
    try:
        size, page = int(_SIZE.read_text()), os.sysconf("SC_PAGE_SIZE")
        pieces = list(_filled(size, page))
    except (OSError, ValueError):
        return "ordinary pages (the kernel has no others)"
    madvise = ctypes.CDLL(None, use_errno=True).madvise
    madvise.argtypes = [ctypes.c_void_p, ctypes.c_size_t, ctypes.c_int]
    until, gathered, why = time.monotonic() + longest_s, 0, ""
    for piece in pieces:
        if time.monotonic() > until:
            break
        if madvise(piece, size, MADV_COLLAPSE) == 0:
            gathered += 1
        else:
            why = f" ({os.strerror(ctypes.get_errno())})"
    if not gathered:
        return f"ordinary pages{why}"
    return f"{gathered * size >> 20} MB in large pages"


def _filled(size: int, page: int) -> Iterator[int]:
    """Addresses of the pieces of ``size`` bytes, aligned, of which most is in memory."""
    pages = size // page
    with Path("/proc/self/pagemap").open("rb", buffering=0) as table:
        for line in Path("/proc/self/maps").read_text().splitlines():
            if (found := _LINE.match(line)) is None:
                continue
            begin, end = int(found[1], 16), int(found[2], 16)
            for piece in range(-(-begin // size) * size, end - size + 1, size):
                entries = os.pread(table.fileno(), 8 * pages, 8 * (piece // page))
                if sum(byte >= _PRESENT for byte in entries[7::8]) >= MOST_OF * pages:
                    yield piece
