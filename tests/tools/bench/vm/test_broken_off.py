"""The making of a bench's system, broken off in the middle: nothing of it goes on, nothing stays mounted."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tools.bench.vm import image

ROOT = Path(__file__).parents[4]
MAKING = """
import signal, sys
from pathlib import Path
from tools.bench.vm import __main__ as command, image, places
signal.signal(signal.SIGTERM, signal.default_int_handler)
place = Path(sys.argv.pop())
places.MEMORY = place.parent
image.missing = lambda build: ""
image._compile = lambda say: image._do(["sleep", "301"], "compiling")
script = f"mount -t tmpfs {place.name} {place}; touch {place}/there; sleep 302 & wait"
image._install = lambda folder, root, say: image._do(["sh", "-c", script], "installing", apart=True)
sys.exit(command.main())
"""
"""A step that starts others and mounts something, and one beside it in another thread."""
BASE = """
import sys
from pathlib import Path
from tests.systemd import container
from tools.bench.vm import places
places.MEMORY = Path(sys.argv.pop())
container.base()
"""
DEBIAN = """#!/bin/sh
mount -t tmpfs {place.name} {place}
touch {place}/there
sleep 302 & sleep 301 & wait
"""
"""In mmdebstrap's place."""
apart = pytest.mark.skipif(os.geteuid() != 0 or not image._may_be_apart(), reason="root may make name spaces")


def running(process: int) -> set[int]:
    """Of a process and of all that it has started."""
    found, left = {process}, [process]
    while left:
        for task in Path(f"/proc/{left.pop()}/task").glob("*/children"):
            children = set(map(int, task.read_text().split())) - found
            found |= children
            left += children
    return found


def alive(process: int) -> bool:
    try:
        return "Z" not in Path(f"/proc/{process}/stat").read_text().rpartition(")")[2]
    except OSError:
        return False


@apart
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_what_makes_an_image_ends_with_the_bench_and_leaves_no_mount(number: int, tmp_path: Path) -> None:
    place = tmp_path / "mounted"
    place.mkdir()
    command = [sys.executable, "-c", MAKING, "--image-only", str(place)]
    code = _broken_off(command, number, place, XDG_CACHE_HOME=str(tmp_path / "cache"))
    assert number == signal.SIGKILL or code == 2


@apart
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_what_makes_the_containers_base_ends_with_the_session_and_leaves_no_mount(number: int, tmp_path: Path) -> None:
    place, programs = tmp_path / "mounted", tmp_path / "bin"
    place.mkdir()
    programs.mkdir()
    (programs / "mmdebstrap").write_text(DEBIAN.format(place=place))
    (programs / "mmdebstrap").chmod(0o755)
    cache = tmp_path / "cache"
    path = f"{programs}:{os.environ['PATH']}"
    command = [sys.executable, "-c", BASE, str(tmp_path)]
    assert _broken_off(command, number, place, PATH=path, XDG_CACHE_HOME=str(cache)) != 0
    assert [one for one in cache.rglob("*") if one.is_file()] == []


def _broken_off(command: list[str], number: int, place: Path, **environment: str) -> int:
    """Send a signal once both sleepers sleep; what it ended with, when nothing of it goes on and nothing is mounted."""
    told = {**os.environ, **environment}
    with subprocess.Popen(command, cwd=ROOT, env=told, stdout=subprocess.PIPE, text=True) as bench:
        end = time.monotonic() + 30.0
        parts: set[int] = set()
        while not {"301", "302"} <= set(map(_last_word, parts)):
            assert time.monotonic() < end, "it has not begun"
            time.sleep(0.05)
            parts = running(bench.pid)
        bench.send_signal(number)
        bench.communicate(timeout=20.0)
    end = time.monotonic() + 5.0
    while left := [one for one in parts if alive(one)]:
        assert time.monotonic() < end, f"{left} go on"
        time.sleep(0.02)
    assert str(place) not in Path("/proc/self/mounts").read_text()
    return bench.returncode


def _last_word(process: int) -> str:
    try:
        return Path(f"/proc/{process}/cmdline").read_text().split("\0")[-2]
    except (OSError, IndexError):
        return ""
