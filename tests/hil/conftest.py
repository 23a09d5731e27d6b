"""Options to ends, needs to skips, coroutines to runs, and what was seen to a report."""

import inspect
import os
import time
from collections.abc import Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from hal.errors import HalError
from tests.hil.ends import FAKE, NONE, AdcEnd, LidarEnd, Operator, operator_for, place_of, where_on_a_bus
from tests.hil.presence import Presence
from tests.hil.programs import Served, demand_lumiloop, program, served_lidar
from tests.hil.walking import Walked, walk_real, walk_simulated
from tools.bench.report.against import Before, CannotCompare, read
from tools.bench.report.page import CannotReport, demand_apart, facts, write
from tools.bench.report.plots import Plot
from tools.bench.report.result import About, Figure, Result

NAME = "hil"
DEVICES = ("lidar", "adc")
DEVICE_OF = {"lidar": "lidar", "served": "lidar", "walk": "lidar", "adc": "adc"}
"""The option that names what a fixture is of."""
KINDS = ("motion", "light", "operator")
TELLING = pytest.StashKey["Telling"]()
PRESENCE = pytest.StashKey[Presence]()
RESULTS = pytest.StashKey[dict[str, Result]]()
BEFORE = pytest.StashKey[Before | None]()
ON_FAKE = pytest.StashKey[bool]()


@dataclass
class Telling:
    """What a test has to say in the report, whether it passes or not."""

    lines: list[str] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    plots: list[Plot] = field(default_factory=list)

    def say(self, text: str) -> None:
        """A line."""
        self.lines.append(text)

    def figure(self, name: str, value: float, unit: str = "", **how: Any) -> None:
        """A number; ``how``: see :class:`tools.bench.report.result.Figure`."""
        self.figures.append(Figure(name, float(value), unit, **how))

    def plot(self, plot: Plot) -> None:
        """A picture."""
        self.plots.append(plot)


@pytest.fixture
def told(request: pytest.FixtureRequest) -> Telling:
    telling = Telling()
    request.node.stash[TELLING] = telling
    return telling


@pytest.fixture(autouse=True)
def compiled_before_the_clock_runs(request: pytest.FixtureRequest) -> None:
    """As for all tests; but first the device is looked at: who has named a wrong one hears of it at once.

    A program that was named has kernels of its own; for a test of it nothing of this tree need be compiled.
    """
    for fixture, option in DEVICE_OF.items():
        if fixture in request.fixturenames:
            _device(request, option)
    if "lumiloop" in request.fixturenames and request.config.getoption("--program"):
        return
    if request.node.get_closest_marker("realtime") or request.node.get_closest_marker("system"):
        request.getfixturevalue("warm_kernels")


@pytest.fixture
def lidar(request: pytest.FixtureRequest) -> LidarEnd:
    name = _device(request, "lidar")
    return LidarEnd(name, _operator(request))


@pytest.fixture
def adc(request: pytest.FixtureRequest) -> AdcEnd:
    name = _device(request, "adc")
    return AdcEnd(name, _operator(request))


@pytest.fixture
def served(request: pytest.FixtureRequest, tmp_path: Path) -> Generator[Served]:
    """The lidar as other programs open it: the real one's name, or the fake as a process with a pty."""
    name = _device(request, "lidar")
    if name != FAKE:
        yield Served(name, _operator(request), tmp_path)
        return
    with served_lidar(tmp_path) as made:
        yield made


@pytest.fixture
def walk(request: pytest.FixtureRequest, lumiloop: list[str], tmp_path: Path) -> Walked:
    """A walk with odometry, recorded by the program under test."""
    name = _device(request, "lidar")
    if name == FAKE:
        return walk_simulated(lumiloop, tmp_path)
    port, seconds = request.config.getoption("--odometry-port"), request.config.getoption("--walk-s")
    return walk_real(lumiloop, Served(name, _operator(request), tmp_path), port, seconds)


@pytest.fixture
def lumiloop(request: pytest.FixtureRequest) -> list[str]:
    """The words that start the program under test."""
    return program(request.config.getoption("--program") or "")


def _operator(request: pytest.FixtureRequest) -> Operator | None:
    return _operator_of(request.config)


def _operator_of(config: pytest.Config) -> Operator | None:
    return operator_for(str(config.getoption("--operator")))


def _device(request: pytest.FixtureRequest, option: str) -> str:
    """The device that an option names, where this test can be tried on it; else the test fails or is skipped."""
    name = named(request.config, option)
    if name == NONE:
        pytest.skip(f"no --{option} named")
    request.node.stash[ON_FAKE] = name == FAKE
    _needs(request, name)
    if name != FAKE:
        request.config.stash[PRESENCE].demand(option, name)
    return name


def named(config: pytest.Config, option: str) -> str:
    """The device of an option; where it is left out a fake, beside another one that is real none: who tries a lidar is
    not told that a converter has passed."""
    if given := config.getoption(f"--{option}"):
        return str(given)
    return NONE if any(config.getoption(f"--{one}") not in (None, FAKE, NONE) for one in DEVICES) else FAKE


def _needs(request: pytest.FixtureRequest, device: str) -> None:
    """Skip a test that needs what this bench does not have; fakes have everything."""
    marked = [kind for mark in request.node.iter_markers("needs") for kind in mark.args]
    assert set(marked) <= set(KINDS), f"{request.node.name} needs {marked}; known are {KINDS}"
    have = _there(request.config)
    lacking = [kind for kind in marked if kind not in have]
    if device != FAKE and lacking:
        remedy = " ".join("--operator terminal" if kind == "operator" else f"--have {kind}" for kind in lacking)
        pytest.skip(f"needs {' and '.join(lacking)} on {device}; where there is: {remedy}")


def _there(config: pytest.Config) -> set[str]:
    """What there is besides the devices; raises `pytest.UsageError` for a word that is not known."""
    have = {text.strip() for text in str(config.getoption("--have")).split(",") if text.strip()}
    if unknown := sorted(have - set(KINDS)):
        raise pytest.UsageError(f"--have {unknown[0]}: known are motion and light; an operator is named by --operator")
    return have | ({"operator"} if config.getoption("--operator") else set())


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """A coroutine is played where its device is; what is wrong with the device fails in its own words."""
    if not inspect.iscoroutinefunction(pyfuncitem.obj):
        return None
    given = {name: pyfuncitem.funcargs[name] for name in inspect.signature(pyfuncitem.obj).parameters}
    end = given.get("lidar") or given["adc"]
    try:
        end.play(lambda: pyfuncitem.obj(**given))
    except HalError as error:
        pytest.fail(str(error), pytrace=False)
    return True


# the report


def pytest_configure(config: pytest.Config) -> None:
    """See early that options say something, that the run to compare with can be read, and the report be written."""
    config.stash[RESULTS] = {}
    config.stash[PRESENCE] = Presence()
    place_of(named(config, "lidar"))
    if (adc := named(config, "adc")) != NONE:
        where_on_a_bus(adc)
    if not 1 <= (port := config.getoption("--odometry-port")) <= 65535:
        raise pytest.UsageError(f"--odometry-port {port}: name a port from 1 to 65535, to which the robot sends")
    if wanted := config.getoption("--program"):
        demand_lumiloop(wanted)
    _operator_of(config)
    _there(config)
    folder = config.getoption("--hil-report")
    if folder and config.getoption("numprocesses", None):
        raise pytest.UsageError("--hil-report tells of one process: leave -n out; a device has one user, too")
    if folder:
        try:
            Path(folder).mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise pytest.UsageError(f"--hil-report {folder}: {error.strerror}; name a folder to write into") from error
        if not os.access(folder, os.W_OK | os.X_OK):
            raise pytest.UsageError(f"--hil-report {folder}: this user may not write into it; name another folder")
    elif config.getoption("--against"):
        raise pytest.UsageError("--against compares with the report of this run: say with --hil-report where it goes")
    config.stash[BEFORE] = None
    if config.getoption("--against"):
        try:
            config.stash[BEFORE] = read(Path(config.getoption("--against")), NAME)
            demand_apart(Path(folder), config.stash[BEFORE], "--hil-report")
        except (CannotCompare, CannotReport) as reason:
            raise pytest.UsageError(f"--against: {reason}") from reason


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """The suite's test of itself is none of a device: it is left out where one is named."""
    if not {named(config, option) for option in DEVICES} - {FAKE, NONE}:
        return
    itself = [item for item in items if item.path == Path(__file__).with_name("test_ends.py")]
    config.hook.pytest_deselected(items=itself)
    items[:] = [item for item in items if item not in itself]


def pytest_collection_finish(session: pytest.Session) -> None:
    """Another run that has nothing of what is to be tried is refused before anything is."""
    before = session.config.stash[BEFORE]
    if before is not None and session.items:
        try:
            before.demand([result_name(item.nodeid) for item in session.items])
        except CannotCompare as reason:
            raise pytest.UsageError(f"--against: {reason}") from reason


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Generator[None, Any, None]:
    """Keep what came of each test of this suite."""
    report = (yield).get_result()
    if report.when != "call" and report.passed:
        return
    if report.failed:
        item.config.stash[PRESENCE].doubt()
    telling = item.stash.get(TELLING, Telling())
    title = (inspect.getdoc(getattr(item, "obj", None)) or item.name).splitlines()[0].rstrip(".")
    skipped = report.longrepr[2].removeprefix("Skipped: ") if report.skipped else ""
    said = "\n".join([*telling.lines, *([report.longreprtext[-3000:]] if report.failed else [])])
    name = result_name(item.nodeid)
    item.config.stash[RESULTS][name] = Result(
        name, title, report.passed, report.duration, said, skipped, tuple(telling.figures), tuple(telling.plots),
        item.stash.get(ON_FAKE, False),
    )  # fmt: skip


def result_name(nodeid: str) -> str:
    """Of a test: its file without the folders, and all of what follows, slashes of a parameter too."""
    file, *rest = nodeid.split("::", 1)
    return "::".join([file.rpartition("/")[2], *rest])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_sessionfinish(session: pytest.Session) -> Generator[None]:
    """Write the report if one is asked for; what has become worse makes the run fail, and is said last."""
    yield
    config = session.config
    results = list(config.stash[RESULTS].values())
    folder = config.getoption("--hil-report")
    if not folder or not results:
        return
    ends = {option: named(config, option) for option in DEVICES}
    ends |= {name: str(config.getoption(f"--{name}") or "-") for name in ("have", "operator", "program", "walk-s")}
    about = About(NAME, "Devices", facts(**ends, when=time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())))
    compared = write(Path(folder), results, about, config.stash[BEFORE])
    say = config.get_terminal_writer()
    for line in (f"report: {folder}/report.html", *compared.closing()):
        say.line(line, red=line.startswith("FAILED"))
    if compared.worse and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED
