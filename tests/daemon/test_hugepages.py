"""Memory gathered into large pages, in processes of their own: what was there, and no more."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from daemon import hugepages

ROOT = Path(__file__).parents[2]

FILLED = """
import ctypes, mmap, sys
from daemon import hugepages

def told(name):
    lines = open("/proc/self/smaps_rollup").read().splitlines()
    return int(next(line for line in lines if line.startswith(name + ":")).split()[1]) / 1024

filled = mmap.mmap(-1, 33 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
for page in range(0, len(filled), 4096):
    filled[page : page + 8] = page.to_bytes(8, "little")
sparse = mmap.mmap(-1, 65 << 20, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
for page in range(0, len(sparse), 8192):
    sparse[page] = 1
large, resident = told("AnonHugePages"), told("Rss")
said = hugepages.gather({limit})
same = all(int.from_bytes(filled[page : page + 8], "little") == page for page in range(0, len(filled), 4096))
print(same, told("AnonHugePages") - large, told("Rss") - resident, said, sep=";")
"""


def gathered(longest_s: float) -> tuple[float, float, str]:
    """MB in large pages and resident MB that came with it, and what was said; the bytes are the same."""
    done = subprocess.run(
        [sys.executable, "-c", FILLED.replace("{limit}", str(longest_s))],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=True,
    )
    same, large, resident, said = done.stdout.strip().split(";")
    assert same == "True"
    return float(large), float(resident), said


def test_what_is_there_is_put_into_large_pages_and_what_is_not_stays_away() -> None:
    large, resident, said = gathered(60.0)
    if said.startswith("ordinary pages"):
        pytest.skip(f"this kernel gives none: {said}")
    assert large >= 30.0
    assert said.endswith(" MB in large pages")
    assert resident < 8.0, "memory that is half there was filled up"


def test_it_takes_no_longer_than_it_may() -> None:
    large, _, said = gathered(-1.0)
    assert large == 0.0
    assert said == "ordinary pages"


def test_a_kernel_without_them_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(hugepages, "_SIZE", tmp_path / "hpage_pmd_size")
    assert hugepages.gather() == "ordinary pages (the kernel has no others)"
