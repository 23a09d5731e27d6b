"""``python -m tools.ci.quick``: run the tests of changed files, most specific first, for at most a minute.

Changed files differ from the merge base with main; uncommitted and untracked ones count. A test file is chosen where it
has changed itself, is named after a changed file, or imports a changed module directly.
"""

import argparse
import ast
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterator, Sequence
from pathlib import Path, PurePosixPath
from typing import Final

import pytest

ROOT: Final = Path(__file__).parents[2]
BUDGET_S: Final = 60.0
STOP_S: Final = 4.0
"""No further test begins so long before the end of the budget."""


def changed(root: Path, base: str = "") -> list[str]:
    """Paths that differ from a commit, by default the merge base with main; deleted and untracked ones included.

    Raises:
        RuntimeError: git is missing or has failed; the text is for people.
    """
    mains = () if base else ("main", "origin/main")
    known = [main for main in mains if _git(root, "branch", "--all", "--list", main).strip()]
    base = _git(root, "merge-base", "HEAD", known[0]).strip() if known else base or "HEAD"
    differing = _git(root, "diff", "--name-only", "--no-renames", "-z", "--relative", base)
    untracked = _git(root, "ls-files", "--others", "--exclude-standard", "-z")
    return sorted({name for name in (differing + untracked).split("\0") if name})


def _git(root: Path, *words: str) -> str:
    try:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    except FileNotFoundError:
        raise RuntimeError("git is not installed") from None
    if done.returncode:
        raise RuntimeError(done.stderr.strip())
    return done.stdout


def choose(root: Path, paths: Sequence[str]) -> list[str]:
    """Test files for changed paths: changed, named after, importing; of equal ones that with fewest imports first."""
    modules = {_module_name(path) for path in paths if path.endswith(".py")}
    found = []
    for file in (root / "tests").rglob("test_*.py"):
        test = file.relative_to(root).as_posix()
        imported = set(_imports(file))
        named, uses = any(is_named_after(test, path) for path in paths), bool(imported & modules)
        if test in paths or named or uses:
            found.append((test not in paths, not named, not uses, len(imported), test))
    return [test for *_, test in sorted(found)]


def _module_name(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def _imports(file: Path) -> Iterator[str]:
    """Dotted names that a file imports; none of a damaged file, which pytest reports better."""
    try:
        nodes = ast.walk(ast.parse(file.read_bytes()))
    except (SyntaxError, ValueError):
        return
    for node in nodes:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def is_named_after(test: str, path: str) -> bool:
    """Whether a test file is named after a file or one of its folders, and lies where the tests mirror that folder."""
    at = PurePosixPath(path)
    folders, mirror = at.parent.parts, PurePosixPath(test).parent.parts[1:]
    if at.name.startswith("test_") or mirror != folders[: len(mirror)]:
        return False
    stem = at.name.lstrip(".").partition(".")[0].lower()
    name = PurePosixPath(test).stem.removeprefix("test_")
    return name == stem or name.startswith(f"{stem}_") or name in (folders[1:] if at.suffix == ".py" else folders)


class Deadline:
    """pytest plugin: ends a run in time.

    Attributes:
        over: whether it has. failed: phases of tests that have failed. waiting: collected tests that have not finished.
    """

    def __init__(self, end: float) -> None:
        """``end``: `time.monotonic` at which the budget ends."""
        self.over, self.failed = False, 0
        self.waiting: dict[str, None] = {}
        self._end, self._ended = end, threading.Event()

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Restore the order of the command line, which other plugins may have changed."""
        order = {Path(name): turn for turn, name in enumerate(config.args)}
        items.sort(key=lambda item: order.get(item.path, len(order)))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """Interrupt a test that outlasts the budget."""
        self.waiting = dict.fromkeys(item.nodeid for item in session.items)
        signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
        threading.Thread(target=self._interrupt, daemon=True).start()
        try:
            return (yield)
        finally:
            self._ended.set()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count failures."""
        self.failed += report.failed

    def pytest_runtest_teardown(self, item: pytest.Item) -> None:
        """Strike the test off the list; at the end of the budget no other test begins."""
        self.waiting.pop(item.nodeid, None)
        if self.waiting and time.monotonic() > self._end - STOP_S:
            self.over = True
            item.session.shouldstop = "the time is over"

    def _interrupt(self) -> None:
        """Interrupt the run once a second from the end of the budget on: a destructor may swallow an interrupt."""
        wait_s = max(self._end - time.monotonic(), 0.0)
        while not self._ended.wait(wait_s):
            self.over, wait_s = True, 1.0
            os.kill(os.getpid(), signal.SIGINT)  # a signal also ends a wait for a lock


def main(words: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """The command; returns the exit code: 0 where no test has failed."""
    deadline = Deadline(time.monotonic() + BUDGET_S)
    parser = argparse.ArgumentParser(prog="python -m tools.ci.quick", description=__doc__.split("\n")[0])
    parser.add_argument("--base", default="", metavar="COMMIT", help="compare with it; default: merge base with main")
    parser.add_argument("--marks", default="not slow and not system", help="pytest's -m (default: %(default)s)")
    parser.add_argument("--list", action="store_true", help="print the choice, run nothing")
    options = parser.parse_args(words)
    try:
        paths = changed(root, options.base)
    except RuntimeError as error:
        parser.error(str(error))
    tests = choose(root, paths)
    print(f"quick: {len(paths)} files have changed; {len(tests)} test files", flush=True)
    if options.list or not tests:
        print(*tests, sep="\n", flush=True)
        return 0
    code = int(pytest.main(["-q", "-m", options.marks, *(str(root / test) for test in tests)], plugins=[deadline]))
    for path, count in Counter(test.partition("::")[0] for test in deadline.waiting if deadline.over).items():
        print(f"quick: left out: {count} tests of {path}", flush=True)
    stopped = deadline.over and code == pytest.ExitCode.INTERRUPTED
    return int(deadline.failed > 0) if stopped else code * (code != pytest.ExitCode.NO_TESTS_COLLECTED)


if __name__ == "__main__":
    sys.exit(main())
