"""``python -m tests.faults.power [CUTS]``: power cuts in starts, saves and an upgrade, on an ext4 of a logged disk.

The writes of some starts, saves and one upgrade are recorded once. Each cut keeps what was flushed before it. Of the
writes since then it keeps all, or some by chance as a disk's cache may, the last one torn between two sectors. The
image is mounted, which plays its journal; the program's own start and the installed version are judged on it. After
some more cuts the whole daemon is started (:mod:`tests.faults.power.whole_daemon`).
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
from collections.abc import Callable
from pathlib import Path
from typing import Final

from tests.faults.power import whole_daemon
from tests.faults.power.disk import Moment, Recording, cut, mounted, place, recorded
from tests.faults.start_files import prepare, run, sessions_in
from tests.systemd.installing import SITE, Bench

CUTS: Final = 120
WHOLE: Final = 10
"""One in so many cuts more is tried with the whole daemon."""
DISK_BYTES: Final = 64 << 20
MEMORY: Final = "/dev/shm" if Path("/dev/shm").is_dir() else None


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
    made = Recording()

    def furnished(folder: Path) -> None:
        furnish(folder)
        made.versions.append(contents(bench_in(folder)))

    with recorded(work, DISK_BYTES, furnished, made) as (folder, at):

        def phase(name: str) -> None:
            made.moments.append(Moment(at(), name, max(sessions_in(folder / "robot"))))

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
    return made


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
    with tempfile.TemporaryDirectory(dir=MEMORY) as name:
        work = Path(name)
        made = record(work)
        phases, wrong = dict[str, int](), []
        spans = list(zip(made.moments, made.moments[1:], strict=False))
        for number in range(cuts):
            begin, end = spans[-2] if number % 3 == 2 else draw.choice(spans)  # a third of them in the upgrade
            last = place(made, begin, end, draw)
            cut(made, work / "base", work / "cut", last, draw, number % 4 % 3)
            with mounted(work / "cut", work / "mount", "defaults") as folder:
                found = judge(made, folder, begin.saved, begin.phase == "after the upgrade")
            phases[begin.phase] = phases.get(begin.phase, 0) + 1
            wrong += [{"cut": number, "phase": begin.phase, "entry": last, "wrong": found}] if found else []
        writes = sum(entry.data is not None for _, entry in made.log)
        flushes = len(made.log) - writes
    daemons = cuts // WHOLE
    with tempfile.TemporaryDirectory(dir=MEMORY) as name:
        failed = whole_daemon.main(daemons, Path(name))
    counts = {"writes": writes, "flushes": flushes, "cuts": phases, "started": cuts - len(wrong), "daemons": daemons}
    return {**counts, "wrong": [*wrong, *failed]}


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
