"""Looks for inputs that reach what no kept one does, and keeps them.

atheris turns the parsers' branches into feedback for libFuzzer. Without it, steps from line to line are watched by the
interpreter itself: the same idea, many times slower. Either way, of what is found the shortest inputs stay that
together take every such step.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import random
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any, Final

from tests.fuzz import storm
from tests.fuzz.storm import say

ROOT = Path(__file__).parents[2]
MOST: Final = 4096
"""Bytes of an input that is kept; some of the shortest maps are larger."""
LONG: Final = {"map": 16384}


def grow(name: str, seconds: float) -> int:
    """Search for so long; 1 where an input broke something (it is written to out/fuzz)."""
    folder = storm.CORPUS / name
    folder.mkdir(parents=True, exist_ok=True)
    before = len(list(folder.iterdir()))
    guided = importlib.util.find_spec("atheris") is not None
    say(f"{name}: {'atheris' if guided else 'lines watched by the interpreter'}, {seconds:.0f} s")
    failed = _with_atheris(name, seconds) if guided else _by_lines(name, seconds)
    kept = list(folder.iterdir())
    say(
        f"{name}: {before} inputs before, {len(kept)} now, {sum(f.stat().st_size for f in kept) / 1e3:.0f} kB",
    )
    return failed


def _with_atheris(name: str, seconds: float) -> int:
    """libFuzzer in a process of its own, and once more to merge what it has found."""
    target = importlib.import_module(f"tests.fuzz.targets.{name}")
    folder, out = storm.CORPUS / name, ROOT / "out" / "fuzz"
    out.mkdir(parents=True, exist_ok=True)
    with TemporaryDirectory(prefix="lumiloop-fuzz-") as holder:
        found = Path(holder)
        keep(found, [*target.seeds(), *storm.corpus(name)])
        command = [sys.executable, "-m", "tests.fuzz.grow", name, str(found), f"-max_len={LONG.get(name, MOST)}"]
        limits = [f"-max_total_time={seconds:.0f}", "-timeout=5", f"-artifact_prefix={out}/{name}-", "-verbosity=0"]
        run = subprocess.run([*command, *limits], cwd=ROOT, check=False)
        inputs = sorted((file.read_bytes() for file in found.iterdir()), key=len)
    steps, feed = Steps(target.PARSERS), target.feeder()
    for data in target.seeds():
        steps.taken_anew(feed, data)  # these need not be kept
    fewest = [data for data in inputs if steps.taken_anew(feed, data)]
    for file in folder.iterdir():
        file.unlink()
    keep(folder, fewest)
    return int(run.returncode != 0)


def libfuzzer(name: str, arguments: list[str]) -> None:
    """The process that atheris takes over."""
    import atheris

    with atheris.instrument_imports(include=["hal", "daemon", "msgspec", "tomllib"]):
        target = importlib.import_module(f"tests.fuzz.targets.{name}")
    feed, mend = target.feeder(), target.mend

    def one(data: bytes) -> None:
        feed(data)
        feed(mend(data))

    atheris.Setup([sys.argv[0], *arguments], one)
    atheris.Fuzz()


def _by_lines(name: str, seconds: float) -> int:
    """Damage what is kept, keep what takes a step that was not taken before."""
    target = importlib.import_module(f"tests.fuzz.targets.{name}")
    steps, feed = Steps(target.PARSERS), target.feeder()
    kept = [*target.seeds(), *storm.corpus(name)]
    for data in kept:
        steps.taken_anew(feed, data)
    search, found = storm.Storm(kept, target.mend, random.randrange(1 << 30)), []
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        data = search.next()
        if len(data) <= LONG.get(name, MOST) and steps.taken_anew(feed, data):
            search.keep(data)
            found.append(data)
    keep(storm.CORPUS / name, found)
    return 0


class Steps:
    """Steps from line to line within some files that were ever taken."""

    def __init__(self, files: tuple[str, ...]) -> None:
        self._files = {str(ROOT / file) for file in files}
        self._taken: set[tuple[str, int, int]] = set()

    def taken_anew(self, feed: Callable[[bytes], None], data: bytes) -> bool:
        """Feed an input; whether it has taken one for the first time."""
        before = len(self._taken)
        sys.settrace(self._call)
        try:
            storm.tell(feed, data)
        finally:
            sys.settrace(None)
        return len(self._taken) > before

    def _call(self, frame: FrameType, event: str, _: Any) -> Any:
        if frame.f_code.co_filename not in self._files:
            return None
        last = 0

        def line(inner: FrameType, what: str, _: Any) -> Any:
            nonlocal last
            if what == "line":
                self._taken.add((inner.f_code.co_filename, last, inner.f_lineno))
                last = inner.f_lineno
            return line

        return line


def keep(folder: Path, inputs: list[bytes]) -> None:
    """Write inputs under names that say what is in them."""
    for data in inputs:
        (folder / hashlib.sha256(data).hexdigest()[:16]).write_bytes(data)


if __name__ == "__main__":
    libfuzzer(sys.argv[1], sys.argv[2:])
