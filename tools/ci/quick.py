"""``python -m tools.ci.quick``: run the tests of what has changed, most specific first, within a time budget.

What has changed: files that differ from the merge base with main, uncommitted and untracked ones included. :class:`Why`
lists the reasons for which a test file is chosen. Durations come from pytest's cache, where ``make test`` keeps them.
"""

from __future__ import annotations

import argparse
import os
import signal
import subprocess
import sys
import threading
import time
from collections import Counter
from collections.abc import Generator, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path, PurePosixPath
from typing import Final

import pytest

from tools.ci.durations import read
from tools.ci.imports import Tree, is_test, module_name

ROOT: Final = Path(__file__).parents[2]
BUDGET_S: Final = 60.0
STARTUP_S: Final = 5.0
"""Part of the budget that is kept for the choice and for pytest's collection."""
STOP_S: Final = 4.0
"""So long before the end of the budget no further test begins."""
UNKNOWN_S: Final = 2.0
"""Assumed for a test file without a stored duration."""
MAINS: Final = ("main", "origin/main")


class Why(IntEnum):
    """Why a test file is chosen, the most specific reason first."""

    CHANGED = 0
    NAMED_AND_USES = 1
    NAMED = 2
    USES = 3  # it imports the module, or a string names the data file
    BESIDE = 4  # it lies in the folder of a changed conftest or data file of the tests
    HELPER = 5  # it imports a changed module through a helper module

    @property
    def words(self) -> str:
        """The reason for people."""
        return self.name.lower().replace("_", " ")


@dataclass(frozen=True, slots=True, order=True)
class Choice:
    """A test file that is worth running. Its order: the reason, then how little else the file imports.

    Attributes:
        imports: how many modules the file imports in all.
    """

    why: Why
    imports: int
    path: str


@dataclass(frozen=True, slots=True)
class Plan:
    """What fits into the budget, and what does not, each with its expected seconds."""

    taken: dict[str, float]
    left: dict[str, float]


def git(root: Path, *words: str) -> str:
    """Output of a git command.

    Raises:
        RuntimeError: it failed, or git is missing; the text is for people.
    """
    try:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True)
    except FileNotFoundError:
        raise RuntimeError("git is not installed") from None
    if done.returncode:
        raise RuntimeError(done.stderr.strip())
    return done.stdout


def merge_base(root: Path, mains: Iterable[str] = MAINS) -> str:
    """Commit at which HEAD left the first of the main branches that exists; HEAD itself where there is none.

    Raises:
        RuntimeError: the folder is in no git repository, or has no commit yet.
    """
    for main in mains:
        if git(root, "branch", "--all", "--list", main).strip():
            return git(root, "merge-base", "HEAD", main).strip()
    return git(root, "rev-parse", "HEAD").strip()


def changed(root: Path, base: str) -> list[str]:
    """Paths that differ between a commit and the working tree, deleted and untracked ones included.

    Raises:
        RuntimeError: git knows no such commit.
    """
    differing = git(root, "diff", "--name-only", "--no-renames", "-z", "--relative", base)
    untracked = git(root, "ls-files", "--others", "--exclude-standard", "-z")
    return sorted({name for name in (differing + untracked).split("\0") if name})


def choose(tree: Tree, paths: Sequence[str]) -> list[Choice]:
    """Test files for changed paths, most specific first."""
    modules = frozenset(module_name(path) for path in paths if path.endswith(".py"))
    found = []
    for test in tree.tests:
        why = _why(tree, test, paths, modules)
        if why is not None:
            found.append(Choice(why, len(tree.facts(test).modules), test))
    return sorted(found)


def _why(tree: Tree, test: str, paths: Sequence[str], modules: frozenset[str]) -> Why | None:
    """The most specific reason; None: the test has nothing to do with the change."""
    facts = tree.facts(test)
    named = any(is_named_after(test, path) for path in paths)
    uses = bool(facts.modules & modules) or any(_names(facts.strings, path) for path in paths)
    if test in paths:
        return Why.CHANGED
    if named:
        return Why.NAMED_AND_USES if uses else Why.NAMED
    if uses:
        return Why.USES
    if any(_beside(tree, test, path) for path in paths):
        return Why.BESIDE
    return Why.HELPER if tree.with_helpers(test) & modules else None


def is_named_after(test: str, path: str) -> bool:
    """Whether a test file is named after a file or its folder, and lies where the tests mirror that folder."""
    at = PurePosixPath(path)
    folders, mirror = at.parent.parts, PurePosixPath(test).parent.parts[1:]
    if is_test(path) or mirror != folders[: len(mirror)]:
        return False
    stem = at.name.lstrip(".").partition(".")[0].lower()
    own = (at.parent.name,) if stem == "__init__" else (stem, f"{at.parent.name}_{stem}")
    packages = folders[1:] if at.suffix == ".py" else folders
    name = PurePosixPath(test).stem.removeprefix("test_")
    return name in own or name in packages or name.startswith(tuple(f"{one}_" for one in own))


def _names(strings: frozenset[str], path: str) -> bool:
    """Whether string constants name a file that is no Python module."""
    name = PurePosixPath(path).name
    return not path.endswith(".py") and any(text == name or text.endswith(path) for text in strings)


def _beside(tree: Tree, test: str, path: str) -> bool:
    """Whether a changed conftest or data file of the tests belongs to a test by its folder."""
    at = PurePosixPath(path)
    if at.parts[0] != "tests" or (at.suffix == ".py" and at.name != "conftest.py"):
        return False
    folder = at.parent
    while not any(PurePosixPath(one).is_relative_to(folder) for one in tree.tests) and folder.name:
        folder = folder.parent
    return PurePosixPath(test).is_relative_to(folder)


def fit(choices: Sequence[Choice], durations: Mapping[str, float], seconds: float) -> Plan:
    """Take test files in their order as long as they fit; where none fits, the first."""
    plan, rest = Plan({}, {}), seconds
    for choice in choices:
        expected = durations.get(choice.path, UNKNOWN_S)
        (plan.taken if expected <= rest else plan.left)[choice.path] = expected
        rest -= expected if expected <= rest else 0.0
    if plan.left and not plan.taken:
        first = choices[0].path
        plan.taken[first] = plan.left.pop(first)
    return plan


@dataclass(slots=True, eq=False)
class Deadline:
    """pytest plugin: ends a run in time, and knows which tests it has cost.

    Attributes:
        at: `time.monotonic` at which the budget ends. over: whether the plugin has ended the run.
        failed: phases of tests that have failed. waiting: collected tests that have not finished.
    """

    at: float
    over: bool = False
    failed: int = 0
    waiting: dict[str, None] = field(default_factory=dict)
    _session: pytest.Session | None = None

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, config: pytest.Config, items: list[pytest.Item]) -> None:
        """Put the tests back into the order of the command line, which other plugins may have changed."""
        order = {Path(config.rootpath, name): turn for turn, name in enumerate(config.args)}
        items.sort(key=lambda item: order.get(item.path, len(order)))

    @pytest.hookimpl(wrapper=True)
    def pytest_runtestloop(self, session: pytest.Session) -> Generator[None, object, object]:
        """Run the clock beside the tests, for one that does not come back."""
        self._session = session
        self.waiting = dict.fromkeys(item.nodeid for item in session.items)
        timer = threading.Timer(max(self.at - time.monotonic(), 0.0), self._interrupt)
        timer.daemon = True
        timer.start()
        try:
            return (yield)
        finally:
            timer.cancel()

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count what fails."""
        self.failed += report.failed

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        """Strike a test off the list; at the end of the budget let no other begin."""
        self.waiting.pop(nodeid, None)
        if self._session is not None and self.waiting and time.monotonic() > self.at - STOP_S:
            self.over = True
            self._session.shouldstop = "the time is over"

    def _interrupt(self) -> None:
        self.over = True
        os.kill(os.getpid(), signal.SIGINT)  # a real signal: it also ends a wait for a lock


def run(root: Path, plan: Plan, marks: str, end: float) -> tuple[int, Counter[str]]:
    """Run the tests of a plan until ``end`` (`time.monotonic`); returns the exit code and the tests left, by file."""
    deadline = Deadline(end)
    files = [str(root / path) for path in plan.taken]
    code = int(pytest.main(["-q", "-m", marks, *files], plugins=[deadline]))
    if deadline.over and code == pytest.ExitCode.INTERRUPTED:
        code = int(deadline.failed > 0)
    nothing = code == pytest.ExitCode.NO_TESTS_COLLECTED
    waiting = deadline.waiting if deadline.over else {}
    return (0 if nothing else code), Counter(nodeid.partition("::")[0] for nodeid in waiting)


def _say(text: str) -> None:
    print(f"quick: {text}", flush=True)


def main(words: Sequence[str] | None = None, root: Path = ROOT) -> int:
    """The command; returns the exit code: 0 where no test has failed."""
    start = time.monotonic()
    parser = _parser()
    options = parser.parse_args(words)
    try:
        base = options.base or merge_base(root)
        paths = changed(root, base)
    except RuntimeError as error:
        parser.error(str(error))
    choices = choose(Tree(root), paths)
    plan = fit(choices, read(root), options.seconds - STARTUP_S)
    expected = sum(plan.taken.values())
    _say(f"{len(paths)} files differ from {base[:10]}; {len(plan.taken)} test files, about {expected:.0f} s")
    if options.list:
        for choice in choices:
            _say(f"{'run' if choice.path in plan.taken else 'out'}  {choice.path}  ({choice.why.words})")
        return 0
    code, unfinished = run(root, plan, options.marks, start + options.seconds) if plan.taken else (0, Counter[str]())
    for path, count in unfinished.items():
        _say(f"out of time: {count} tests of {path}")
    for path, seconds in plan.left.items():
        _say(f"left out: {path}, about {seconds:.0f} s")
    return code


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.ci.quick", description=__doc__.split("\n")[0])
    parser.add_argument("--base", metavar="COMMIT", help="what to compare with; default: the merge base with main")
    parser.add_argument("--seconds", type=float, default=BUDGET_S, help="time budget (default %(default)g s)")
    parser.add_argument("--marks", default="not slow and not system", help="pytest's -m (default: %(default)s)")
    parser.add_argument("--list", action="store_true", help="print the choice and its reasons, run nothing")
    return parser


if __name__ == "__main__":
    sys.exit(main())
