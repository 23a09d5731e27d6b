"""``python -m tests.faults.failing_calls [calls|cuts] [SHARE]``: file operations of a start that fail, and power cuts.

``calls``: each file operation of a start and a save fails once, in each of the ways of `WAYS`. The start comes to its
end or ends with a text, and so does the next one, and no good map is lost.
``cuts``: power cuts at random operations, after which everything that had not been synced is empty, cut, or garbage;
in a third of them also what had been, as on a disk that syncs nothing. The next start comes to its end, with the map of
before or after.
SHARE: of the operations, 1 for all (default). Prints counts as JSON. Needs a C compiler.
"""

from __future__ import annotations

import ctypes
import errno
import json
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import traceback
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Final

from daemon.system import regular_file
from tests.faults.start_files import SAID, prepare, run, sessions_in

SHORT, CUT = -1, -2
WAYS: Final = {
    "ENOSPC": errno.ENOSPC,
    "EIO": errno.EIO,
    "EINTR": errno.EINTR,
    "EACCES": errno.EACCES,
    "EROFS": errno.EROFS,
    "ENOMEM": errno.ENOMEM,
    "short": SHORT,
}
CUTS: Final = 120
STARTED, ENDED_WITH_TEXT, DEFECT, POWERLESS = 0, 3, 4, 99
LONGEST_S: Final = 30
"""After which a run is killed by SIGALRM, s."""


def preloaded(words: list[str]) -> subprocess.CompletedProcess[str]:
    """Run this module with the library that spoils calls."""
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "failing_calls.so"
        source = Path(__file__).with_name("failing_calls.c")
        subprocess.run(["cc", "-shared", "-fPIC", "-O2", "-o", str(library), str(source), "-ldl"], check=True)
        environment = {**os.environ, "LD_PRELOAD": str(library)}
        command = [sys.executable, "-m", "tests.faults.failing_calls", *words]
        root = Path(__file__).parents[2]
        return subprocess.run(command, cwd=root, env=environment, stdout=subprocess.PIPE, text=True, check=False)


def in_child(work: Callable[[], object], spoil: tuple[bytes, int, int, int]) -> int:
    """Exit status of a child process that does the work with one call spoilt."""
    child = os.fork()
    if child == 0:
        status = DEFECT
        try:
            ctypes.CDLL(None).alarm(LONGEST_S)
            ctypes.CDLL(None).spoil(*spoil)
            work()
            status = STARTED
        except SAID:
            status = ENDED_WITH_TEXT
        except BaseException:  # noqa: BLE001  the child must not return
            traceback.print_exc()
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def count_of(folder: Path) -> int:
    """Number of file operations of a run that nothing spoils."""
    library = ctypes.CDLL(None)
    library.spoil(str(folder).encode(), 0, 0, -1)
    run(folder)
    return int(library.calls())


def failing_calls(root: Path, share: float) -> dict[str, object]:
    """Let each call fail once in each way; see the module's text."""
    good, folder = root / "good", root / "run"
    prepare(good)
    shutil.copytree(good, folder)
    total, draw = count_of(folder), random.Random(1)
    results, wrong = Counter[str](), []
    for name, way in WAYS.items():
        for call in range(1, total + 1):
            if draw.random() >= share:
                continue
            shutil.rmtree(folder)
            shutil.copytree(good, folder)
            before = sessions_in(folder)
            first = in_child(lambda: run(folder), (str(folder).encode(), call, way, -1))
            kept = sessions_in(folder)
            second = in_child(lambda: run(folder), (b"", 0, 0, -1))
            results[{STARTED: "started", ENDED_WITH_TEXT: "ended with a text"}.get(first, "defect")] += 1
            lost = max(kept, default=0) < max(before)
            if first not in (STARTED, ENDED_WITH_TEXT) or second != STARTED or lost:
                wrong.append({"call": call, "way": name, "exit": [first, second], "maps": [before, kept]})
    return {"calls": total, **results, "wrong": wrong}


def power_cuts(root: Path, share: float) -> dict[str, object]:
    """Cut the power at random calls of a first start, and of a later one; see the module's text."""
    good, folder, draw = root / "good", root / "run", random.Random(2)
    prepare(good)
    wrong, cuts, damaged = [], 0, 0
    for number in range(round(CUTS * share)):
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(good, folder)
        if number % 2:  # a first start, or one of another version
            shutil.rmtree(folder / "kernels")
            (folder / "kernels").mkdir()
        spare = root / "spare"
        shutil.copytree(folder, spare)
        total = count_of(spare)
        shutil.rmtree(spare)
        before, trace = max(sessions_in(folder)), root / "trace"
        with trace.open("wb") as file:
            cut = in_child(lambda: run(folder), (str(folder).encode(), draw.randint(1, total), CUT, file.fileno()))
        cuts += cut == POWERLESS
        for path in unsynced(trace.read_text().splitlines(), lying=number % 3 == 0):
            damaged += spoil(path, draw)
        begun = root / "begun"
        begun.write_text("-1")
        status = in_child(lambda: begun.write_text(str(run(folder))), (b"", 0, 0, -1))  # noqa: B023  it is run at once
        found = int(begun.read_text())
        if status != STARTED or found not in (before, before + 1):
            wrong.append({"cut": number, "exit": [cut, status], "maps": [before, found]})
    return {"cuts": cuts, "damaged files": damaged, "started": round(CUTS * share) - len(wrong), "wrong": wrong}


def unsynced(trace: list[str], lying: bool = False) -> list[Path]:
    """Files that were written and not synced, by the names they had at the cut; a lying disk syncs nothing."""
    dirty = dict[str, bool]()
    for line in trace:
        what, path, to = line.split("\t")
        if what == "write":
            dirty[path] = True
        elif what == "sync":
            if not lying:
                dirty.pop(path, None)
        elif path in dirty:
            dirty[to] = dirty.pop(path)
        else:
            dirty.pop(to, None)
    return [Path(path) for path in dirty if Path(path).is_file()]


def spoil(path: Path, draw: random.Random) -> int:
    """Leave of a file what a power cut may leave; 1."""
    data = path.read_bytes()
    at = draw.randint(0, len(data))
    left = [b"", data[:at], data[:at] + bytes(len(data) - at), bytes(len(data)), draw.randbytes(len(data)), data]
    path.write_bytes(draw.choice(left))
    return 1


def main(what: str, share: float) -> dict[str, object]:
    """Run the trials in a temporary folder."""
    logging.disable(logging.CRITICAL)
    regular_file.PAUSE_S = 0.0  # type: ignore[misc]  # a pause between tries, which no trial needs
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as root:
        return {"calls": failing_calls, "cuts": power_cuts}[what](Path(root), share)


if __name__ == "__main__":
    arguments = sys.argv[1:] or ["calls"]
    if not hasattr(ctypes.CDLL(None), "spoil"):
        done = preloaded(arguments)
        sys.stdout.write(done.stdout)
        raise SystemExit(done.returncode)
    result = main(arguments[0], float(arguments[1]) if len(arguments) > 1 else 1.0)
    sys.stdout.write(json.dumps(result) + "\n")
    raise SystemExit(1 if result["wrong"] else 0)
