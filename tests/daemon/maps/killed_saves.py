"""``python -m tests.daemon.maps.killed_saves FOLDER KILLS SEED``: saves of maps, killed at random moments by SIGKILL.

A child saves one map after the other and tells each that is done; after a random time it is killed. Whatever is found
then must be a whole map: the last that was told, or the one after it. Prints what was found, as JSON.
"""

import json
import os
import random
import signal
import sys
import time
from pathlib import Path
from typing import Final

from daemon.maps.container import pack, unpack
from daemon.maps.schema import Meta, read
from daemon.maps.store import Store
from tests.daemon.support.map_maker import Shape, content

MAP: Final = 0x51
LONGEST_S: Final = 0.08
"""Some saves of the size that is saved here; the moment of the kill is anywhere in them."""


def main(folder: Path, kills: int, seed: int) -> dict[str, object]:
    """Kill so often; how often which map was found."""
    draw = random.Random(seed)
    tables = unpack(content(Shape(submaps=12, frames=4, beams=361, map_id=MAP)))
    meta = read(pack(tables)).meta
    first = Store(folder)
    first.save(numbered(tables, meta, 0), MAP)
    first.close()
    at, found, left = 0, {"old": 0, "new": 0}, 0
    for _ in range(kills):
        told = killed(folder, tables, meta, at, draw.uniform(0.0, LONGEST_S))
        left += len(list(folder.glob(".*.part")))
        start = Store(folder).load()
        assert start is not None, f"neither after {told}"
        at = start.stored.meta.session
        assert at in (told, told + 1), f"found {at} after {told} had been told"
        found["new" if at == told + 1 else "old"] += 1
    broken = len(list(folder.glob("*.broken")))
    return {"kills": kills, **found, "half_written": left, "broken": broken, "saves": at}


def numbered(tables: dict[str, object], meta: Meta, number: int) -> bytes:
    """A map file that can be told from the others."""
    who = Meta(meta.map_id, meta.name, meta.surveyed, meta.survey, number)
    return pack({**tables, "meta": who.packed()})  # type: ignore[dict-item]  # arrays, as unpacked


def killed(folder: Path, tables: dict[str, object], meta: Meta, at: int, seconds: float) -> int:
    """Let a child save from number ``at`` on, kill it; the number of the last save that it told."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            save_on(Store(folder), tables, meta, at, writer)
        finally:
            os._exit(1)
    os.close(writer)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    told = b""
    while chunk := os.read(reader, 4096):
        told += chunk
    os.close(reader)
    return int.from_bytes(told[-4:], "big") if told else at


def save_on(store: Store, tables: dict[str, object], meta: Meta, at: int, writer: int) -> None:
    """Save one map after the other until killed."""
    while True:
        at += 1
        store.save(numbered(tables, meta, at), MAP)
        os.write(writer, at.to_bytes(4, "big"))


if __name__ == "__main__":
    sys.stdout.write(json.dumps(main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))) + "\n")
