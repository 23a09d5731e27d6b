"""``python -m tests.faults.power [CUTS]``: power cuts in starts, saves and an upgrade, on an ext4 of a logged disk.

The writes of some starts, saves and one upgrade are recorded once. Each cut keeps what was flushed before it. Of the
writes since then it keeps all, or some by chance as a disk's cache may, the last one torn between two sectors. The
image is mounted, which plays its journal; the program's own start and the installed version are judged on it.
Prints counts as JSON; needs root, /dev/fuse and loop devices. Mounts are seen by this process alone.
"""

from __future__ import annotations

import json
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from tests.faults.power.logged_disk import Entry, entries
from tests.faults.start_files import prepare, run, sessions_in
from tests.systemd.installing import SITE, Bench

CUTS: Final = 120
DISK_BYTES: Final = 64 << 20
SECTOR: Final = 512
OPTIONS: Final = "commit=1"
"""Of the mount while it is recorded: the journal is written once a second, so that short work has many states."""


@dataclass(frozen=True)
class Moment:
    """What holds from a place in the log on: phase, number of the latest map that was saved."""

    at: int
    phase: str
    saved: int


@dataclass
class Recording:
    """Writes by their place in the log, the moments, and the file listings of the versions that were in use."""

    log: list[tuple[int, Entry]] = field(default_factory=list)
    moments: list[Moment] = field(default_factory=list)
    versions: list[dict[str, bytes]] = field(default_factory=list)


def tool(*words: object) -> str:
    """Run a program of the system."""
    return subprocess.run([str(word) for word in words], check=True, capture_output=True, text=True).stdout.strip()


@contextmanager
def mounted(disk: Path, folder: Path, options: str) -> Iterator[Path]:
    """An image as a file system, by a loop device."""
    device = tool("losetup", "--find", "--show", disk)
    try:
        folder.mkdir(exist_ok=True)
        tool("mount", "-t", "ext4", "-o", options, device, folder)
        try:
            yield folder
        finally:
            tool("umount", folder)
    finally:
        tool("losetup", "--detach", device)


@contextmanager
def logged(image: Path, folder: Path, log: Path) -> Iterator[Path]:
    """An image as a file whose writes are logged."""
    folder.mkdir()
    words = [sys.executable, "-m", "tests.faults.power.logged_disk", str(folder), str(image), str(log)]
    with subprocess.Popen(words) as server:
        try:
            end = time.monotonic() + 20.0
            while not (folder / "disk").exists():
                assert server.poll() is None
                assert time.monotonic() < end
                time.sleep(0.05)
            yield folder / "disk"
        finally:
            tool("umount", folder)
            server.wait(20.0)


def in_child(work: Callable[[], object]) -> bool:
    """Whether the work comes to its end in a process of its own, whose files are closed after it."""
    child = os.fork()
    if child == 0:
        status = 1
        try:
            work()
            status = 0
        except BaseException:  # noqa: BLE001  the child must not return
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def bench_in(folder: Path) -> Bench:
    """The installation on the disk."""
    return Bench(folder / "installation")


def furnish(folder: Path) -> None:
    """What is on the disk before anything is recorded: an installed version, an unpacked package, a robot's folders."""
    (folder / "installation").mkdir()
    bench = bench_in(folder)
    done = bench.order("build", script="environment.py")
    assert done.returncode == 0, done.stderr
    shutil.copytree(bench.root.resolve(), bench.versions / ".package", symlinks=True)
    (bench.versions / ".package" / SITE / "numpy.py").write_text("x = 2\n")
    assert in_child(lambda: prepare(folder / "robot"))


def contents(bench: Bench) -> dict[str, bytes]:
    """Files of the version in use by their names in it; its own folder is named VERSION in them."""
    root = bench.root.resolve(strict=True)
    own = os.fsencode(root.name)
    files = {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}
    return {name: text.replace(own, b"VERSION") for name, text in files.items()}


def record(work: Path) -> Recording:
    """Record first starts, later ones with their saves, and an upgrade."""
    made, log = Recording(), work / "log"
    image = work / "image"
    with image.open("wb") as file:
        file.truncate(DISK_BYTES)
    tool("mkfs.ext4", "-q", "-F", image)
    with mounted(image, work / "mount", "defaults") as folder:
        furnish(folder)
        made.versions.append(contents(bench_in(folder)))
    shutil.copy(image, work / "base")
    with logged(image, work / "fuse", log) as disk, mounted(disk, work / "mount", OPTIONS) as folder:

        def phase(name: str) -> None:
            made.moments.append(Moment(log.stat().st_size, name, max(sessions_in(folder / "robot"))))

        for number in range(3):
            shutil.rmtree(folder / "robot/kernels")  # another version's
            (folder / "robot/kernels").mkdir()
            phase("start")
            assert in_child(lambda: run(folder / "robot"))
            for _ in range(2):
                phase("save")
                assert in_child(lambda: run(folder / "robot"))
            time.sleep(1.0 * (number < 2))  # the journal is written, and work goes on after it
        phase("upgrade")
        done = bench_in(folder).order("compose", script="environment.py")
        assert done.returncode == 0, done.stderr
        phase("after the upgrade")
        assert in_child(lambda: run(folder / "robot"))
        made.versions.append(contents(bench_in(folder)))
        phase("end")
    made.log = list(entries(log.read_bytes()))
    return made


def cut(made: Recording, base: Path, image: Path, last: int, draw: random.Random, way: int) -> None:
    """Make the image that a power cut after ``last`` entries leaves; ``way`` 0: all of them, 1: some, 2: torn."""
    shutil.copy(base, image)
    done = [entry for _, entry in made.log[:last]]
    flushed = max((number for number, entry in enumerate(done) if entry.data is None), default=0)
    kept = [one for number, one in enumerate(done) if number < flushed or way == 0 or draw.random() < 0.5]
    with image.open("r+b") as file:
        for number, one in enumerate(kept):
            data = one.data or b""
            if way == 2 and number == len(kept) - 1 and number >= flushed:
                data = data[: SECTOR * draw.randint(0, len(data) // SECTOR)]
            file.seek(one.offset)
            file.write(data)


def judge(made: Recording, folder: Path, saved: int, after: bool) -> list[str]:
    """What is wrong after a cut; ``saved``: number of the map that must be there, or the next one."""
    wrong = []
    bench = bench_in(folder)
    try:
        found = contents(bench)
        if found not in made.versions or (after and found != made.versions[1]):
            wrong.append("the version in use is none of the two")
    except OSError as error:
        wrong.append(f"no version is in use: {error}")
    kept = max(sessions_in(folder / "robot"), default=-1)
    if kept < saved:
        wrong.append(f"map {saved} was saved, {kept} is there")
    if not in_child(lambda: run(folder / "robot")):
        wrong.append("it does not start")
    done = bench.order("compose", script="environment.py")
    if done.returncode or len(bench.kept()) != 1:
        wrong.append(f"the upgrade cannot be repeated: {done.stderr}")
    return wrong


def main(cuts: int) -> dict[str, object]:
    """Record once, cut often; the counts."""
    logging.disable(logging.CRITICAL)
    draw = random.Random(3)
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as name:
        work = Path(name)
        made = record(work)
        phases, wrong = dict[str, int](), []
        spans = list(zip(made.moments, made.moments[1:], strict=False))
        for number in range(cuts):
            begin, end = spans[-2] if number % 3 == 2 else draw.choice(spans)  # a third of them in the upgrade
            places = [at for at, (size, _) in enumerate(made.log, 1) if begin.at < size <= end.at]
            last = draw.choice(places)
            cut(made, work / "base", work / "cut", last, draw, number % 4 % 3)
            with mounted(work / "cut", work / "mount", "defaults") as folder:
                found = judge(made, folder, begin.saved, begin.phase == "after the upgrade")
            phases[begin.phase] = phases.get(begin.phase, 0) + 1
            wrong += [{"cut": number, "phase": begin.phase, "entry": last, "wrong": found}] if found else []
        writes = sum(entry.data is not None for _, entry in made.log)
        flushes = len(made.log) - writes
        return {"writes": writes, "flushes": flushes, "cuts": phases, "started": cuts - len(wrong), "wrong": wrong}


def apart(words: list[str]) -> int:
    """Run this module where nobody else sees its mounts, and all of its processes end with it."""
    unshare = ["unshare", "--mount", "--pid", "--fork", "--kill-child", "--mount-proc", "--"]
    command = [*unshare, sys.executable, "-m", "tests.faults.power", "here", *words]
    return subprocess.run(command, check=False, cwd=Path(__file__).parents[3]).returncode


if __name__ == "__main__":
    if sys.argv[1:2] != ["here"]:
        raise SystemExit(apart(sys.argv[1:]))
    result = main(int(sys.argv[2]) if len(sys.argv) > 2 else CUTS)
    sys.stdout.write(json.dumps(result) + "\n")
    raise SystemExit(1 if result["wrong"] else 0)
