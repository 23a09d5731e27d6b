"""Power cuts on a block device; `make power-cuts` makes 120 of them."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.faults.power.disk import Recording, cut
from tests.faults.power.logged_disk import HEADER, Entry, entries

NEEDED = ("unshare", "losetup", "mkfs.ext4", "mount", "umount")
ABLE = (
    os.geteuid() == 0
    and all(map(shutil.which, NEEDED))
    and all(map(os.path.exists, ("/dev/fuse", "/dev/loop-control")))
)
QUICK_CUTS = 24


@pytest.mark.system
@pytest.mark.skipif(not ABLE, reason=f"needs root, /dev/fuse, loop devices and {', '.join(NEEDED)}")
def test_a_power_cut_at_any_write_leaves_a_start_the_map_and_a_version() -> None:
    words = [sys.executable, "-m", "tests.faults.power", str(QUICK_CUTS)]
    done = subprocess.run(words, cwd=Path(__file__).parents[2], capture_output=True, text=True)
    found = json.loads(done.stdout)
    assert found["wrong"] == []
    assert found["started"] == QUICK_CUTS
    assert found["daemons"] == QUICK_CUTS // 10
    assert found["flushes"] > 100
    assert set(found["cuts"]) >= {"start", "save", "upgrade"}


def test_a_log_is_read_as_it_was_written() -> None:
    log = b"".join(HEADER.pack(kind, at, len(data)) + data for kind, at, data in ((b"W", 7, b"abc"), (b"F", 0, b"")))
    assert [entry for _, entry in entries(log)] == [Entry(7, b"abc"), Entry(0, None)]
    assert [at for at, _ in entries(log)] == [HEADER.size + 3, len(log)]


def test_a_cut_keeps_what_was_flushed_and_some_of_the_rest(tmp_path: Path) -> None:
    base, image = tmp_path / "base", tmp_path / "cut"
    base.write_bytes(bytes(1024 * 40))
    writes = [Entry(1024 * number, b"\1" * 1024) for number in range(40)]
    log = [*writes[:10], Entry(0, None), *writes[10:]]
    made = Recording(log=list(enumerate(log)))
    seen = set[int]()
    for way in (0, 1, 2):
        cut(made, base, image, 31, random.Random(way), way)
        data = image.read_bytes()
        assert data[: 1024 * 10] == b"\1" * 1024 * 10
        assert data[1024 * 30 :] == bytes(1024 * 10), "nothing after the cut"
        seen.add(data.count(1))
    assert max(seen) == 1024 * 30
    assert len(seen) == 3
