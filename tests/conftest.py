"""Options shared by all tests: which device end to use, and where real logs are."""

import argparse
import asyncio
import contextlib
import gc
import inspect
import os
import subprocess
import sys
from collections.abc import Generator, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings

from hal.clock import run_virtual
from tests.commands import done, refused  # noqa: F401  # fixtures
from tests.pace import Pace, judge

settings.register_profile("the same examples", deadline=None, derandomize=True)
settings.register_profile("search", deadline=None)
settings.load_profile("the same examples")
"""How long an example takes on a shared machine says nothing (`tests/fuzz` judges stalls). `make fuzz` searches anew
each time, with ``--hypothesis-profile=search``."""

ROOT = Path(__file__).parents[1]
UNTRACED = ("estimator", "faults", "fuzz", "hil", "logs", "tools")
"""Folders of storms and drives: they go over the same lines a million times, for which tracing takes two to five times
as long, and reach hardly one that the other tests do not (see `tools.ci.floors`). The estimator's are traced in the
row without the compiler."""

FIRST = (
    "tools/test_programs.py",
    "faults/test_matrix.py",
    "systemd/test_container.py",
    "tools/experiments/integrity/test_campaign.py",
    "logs/test_figures.py",
)
"""Files that take minutes, longest first: where files are shared out to the cores none of them is begun last."""
COMPILING_S = 900.0
PACE = pytest.StashKey[Pace]()
"""Pace of the machine beside a test of real time."""
LIMIT = pytest.StashKey[tuple[pytest.Item, Any]]()
"""The test whose time runs, and its limit as pytest-timeout has it."""


def named_by(text: str) -> str:
    """An option that names something: empty it is a variable of the shell that nobody has set."""
    if not text.strip():
        raise argparse.ArgumentTypeError("it is empty: name one, or leave the option out")
    return text


def pytest_addoption(parser: pytest.Parser) -> None:
    lidars = "fake, or a real device: /dev/ttyACM0, /dev/ttyUSB0@115200, tcp://192.168.0.10:10940"
    parser.addoption("--lidar", type=named_by, help=lidars)
    converters = "fake, or a real converter: /dev/i2c-1@0x4d, /dev/i2c-1@0x54,adc121c021"
    parser.addoption("--adc", type=named_by, help=converters)
    hil = parser.getgroup("tests/hil", "the suite on devices (docs/bench.md)")
    hil.addoption("--have", default="", help="what real devices can be given: motion,light")
    hil.addoption(
        "--operator", default="", help="who plugs and covers: terminal (a person there), or a unix socket for orders"
    )
    hil.addoption("--program", type=named_by, help="the lumiloop to try; default: of this tree")
    hil.addoption("--odometry-port", type=int, default=5601, help="UDP port to which the robot sends odometry")
    hil.addoption("--walk-s", type=float, default=60.0, help="seconds of the calibration walk on a real robot")
    hil.addoption("--hil-report", metavar="DIR", help="write report.html, junit.xml and results.json of tests/hil")
    hil.addoption("--against", metavar="OLD", help="another run's report folder or results.json; what is worse fails")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if any(item.path.is_relative_to(ROOT / "tests" / folder) for folder in UNTRACED):
            item.add_marker(pytest.mark.no_cover)
    items.sort(key=_turn)


def _turn(item: pytest.Item) -> int:
    """Place of its file in :data:`FIRST`; all others behind them, in the order in which they were."""
    name = item.path.relative_to(ROOT / "tests").as_posix()
    return FIRST.index(name) if name in FIRST else len(FIRST)


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a coroutine test in an event loop of its own, with the mark ``virtual`` in virtual time."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}
    run = run_virtual if pyfuncitem.get_closest_marker("virtual") else asyncio.run
    run(pyfuncitem.obj(**given))
    return True


@pytest.fixture(scope="session")
def log_root() -> Path:
    """Folder of real recorded logs; unset: skip and say why. Set but missing: fail."""
    root = os.environ.get("LUMILOOP_DATA")
    if not root:
        pytest.skip("LUMILOOP_DATA is not set: it names the folder of real recorded logs (see docs/data.md)")
    path = Path(root)
    if not path.is_dir():
        pytest.fail(f"LUMILOOP_DATA={root} is not a folder")
    return path


@pytest.fixture(scope="session")
def warm_kernels(request: pytest.FixtureRequest) -> None:
    """Compile the kernels of this tree once, before anything is judged against the wall clock."""
    compile_kernels(request.config)


def compile_kernels(config: pytest.Config) -> None:
    """Compile the kernels of this tree where they are missing; that is said, and no test's time is taken for it."""
    from daemon.runtime.warmup import is_warm

    plugins = config.pluginmanager
    terminal, capture = plugins.get_plugin("terminalreporter"), plugins.get_plugin("capturemanager")
    if terminal is not None and not is_warm(lights=False):
        with contextlib.nullcontext() if capture is None else capture.global_and_fixture_disabled():
            terminal.ensure_newline()
            terminal.write_line("the kernels of this tree are compiled first, once: that takes a minute or two")
    command = [sys.executable, "-c", "from daemon.runtime.warmup import load; load()"]
    with untimed(config):
        subprocess.run(command, cwd=ROOT, check=True, timeout=COMPILING_S)


@contextlib.contextmanager
def untimed(config: pytest.Config) -> Iterator[None]:
    """The time of the test that is being set up stands still meanwhile, and begins anew afterwards.

    A Raspberry Pi compiles for longer than a test may take, and pytest-timeout counts what a test waits for, too.
    """
    running = config.stash.get(LIMIT, None)
    if running is None:
        yield
        return
    item, settings = running
    config.hook.pytest_timeout_cancel_timer(item=item)
    try:
        yield
    finally:
        config.hook.pytest_timeout_set_timer(item=item, settings=settings)


@pytest.hookimpl(tryfirst=True, optionalhook=True)
def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> None:
    """Remember whose time runs; the timer itself is pytest-timeout's."""
    item.config.stash[LIMIT] = item, settings


@pytest.hookimpl(tryfirst=True, optionalhook=True)
def pytest_timeout_cancel_timer(item: pytest.Item) -> None:
    """Nobody's does."""
    if LIMIT in item.config.stash:
        del item.config.stash[LIMIT]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Measure the pace of the machine beside a test that is judged against the wall clock."""
    if item.get_closest_marker("realtime") is None:
        return (yield)
    pace = item.stash[PACE] = Pace()
    try:
        return (yield)
    finally:
        pace.stop()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """A failure on a machine that is too busy is no verdict."""
    report = yield
    judge(report, item.stash.get(PACE, None))
    return report


@pytest.fixture(autouse=True)
def nothing_stays(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """What a process does to itself for good - objects frozen, its priority - would outlast the test that does it."""
    monkeypatch.setattr(os, "nice", lambda by: by)
    yield
    gc.unfreeze()


@pytest.fixture(autouse=True)
def maps_of_its_own(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a daemon keeps from one run to the next must not reach another test, nor a person's own maps."""
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))


@pytest.fixture(autouse=True)
def compiled_before_the_clock_runs(request: pytest.FixtureRequest) -> None:
    """Tests of real processes in real time start warm, whichever test happens to come first."""
    if request.node.get_closest_marker("realtime") or request.node.get_closest_marker("system"):
        request.getfixturevalue("warm_kernels")
