"""The first start ever, from an empty folder of kernels: once it drives, nothing is compiled any more."""

import ast
import contextlib
import subprocess
import sys
import time
from pathlib import Path

import pytest

import estimator
from daemon.config.survey_loader import write_survey
from daemon.devices.light_setup import Lights
from daemon.runtime.warmup import load
from daemon.snapshot import State
from estimator.cdma.air_interface import PROFILE_A
from tests.daemon.processes.test_lights_process import served
from tests.daemon.processes.test_process import ROOT, fake_lidar, running
from tests.daemon.support.light_room import SURVEY

COMPILES_S = 600.0
DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef)
FIRST_STATE_S = 33.0
"""Until a ring of a minute has its first state."""


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.timeout(900)
@pytest.mark.parametrize("lit", [False, True], ids=["laser", "lidar and light"])
def test_nothing_is_compiled_once_it_drives(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, lit: bool) -> None:
    """With a recorder, which loads more than a start without."""
    cache, link = tmp_path / "cache", tmp_path / "lidar"
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(cache))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    keys = ["--record", str(tmp_path / "ring"), "--last", "1"]
    lamps = contextlib.nullcontext()
    if lit:
        load(Lights(SURVEY, PROFILE_A))  # in this process, for the fake: into the folder that it began with
        write_survey(tmp_path / "lights.toml", SURVEY)
        bus = f"unix:{tmp_path / 'bus'}"
        keys += ["--set", f"photodiode.bus={bus}", "--set", f"lights.survey={tmp_path / 'lights.toml'}"]
        lamps = served(bus)
    with fake_lidar(link), lamps, running(link, *keys) as daemon:
        daemon.until(COMPILES_S, "state", *set(State) - {State.STARTING, State.NO_LIDAR})
        time.sleep(FIRST_STATE_S)
        code, said, _ = daemon.stop()
    assert code == 0
    assert "kernels compiled in" in said
    assert list((tmp_path / "ring").glob("*/*.lumistate")), "a state was taken"
    (mark,) = cache.glob("kernels-*/warm-*")
    late = [path.name for path in cache.rglob("*.nb[ic]") if path.stat().st_mtime_ns > mark.stat().st_mtime_ns]
    assert late == []


LATE = """
import sys
from importlib import import_module
from pathlib import Path
import daemon.recording.recorder, daemon.cli.run
from daemon.runtime import warmup
from daemon.devices.light_setup import Lights
from estimator.cdma.air_interface import PROFILE_A
from estimator.light_filter.survey import Survey

lit, *names = sys.argv[1:]
warmup.load(Lights(Survey(), PROFILE_A) if lit == "lit" else None)
before = set(sys.modules)
for name in names:
    import_module(name)
new = [sys.modules[name] for name in sorted(set(sys.modules) - before) if name.startswith("estimator.")]
print([one.__name__ for one in new if "\\n@kernel(" in Path(one.__file__).read_text()])
"""
OF_LIGHT = "loaded by the warm-up where there is a photodiode, and needed nowhere else"
OFFLINE = {"daemon.cli.maps.convert": "of `lumiloop export` and `lumiloop plan`, which are no daemons"}
EXCEPT = {
    "laser": OFFLINE | {"estimator.cdma.decoder": OF_LIGHT, "estimator.light_filter.light_channel": OF_LIGHT},
    "lit": OFFLINE,
}
"""What is imported inside of functions and may have kernels, and why."""


def imported_inside_functions() -> set[str]:
    """Modules of the daemon and the estimator that one of the daemon's loads only when it comes to that line."""
    found = set()
    for file in (ROOT / "daemon").rglob("*.py"):
        bodies = [one for one in ast.walk(ast.parse(file.read_text())) if isinstance(one, DEFINITIONS)]
        for line in (line for body in bodies for line in ast.walk(body)):
            if isinstance(line, ast.ImportFrom) and line.module == "estimator":
                found |= {exporter(one.name) for one in line.names}
            elif isinstance(line, ast.Attribute) and ast.unparse(line.value) == "estimator":
                found.add(exporter(line.attr))
            elif isinstance(line, ast.ImportFrom) and line.module:
                found |= {line.module, *(f"{line.module}.{one.name}" for one in line.names)}
            elif isinstance(line, ast.Import):
                found |= {one.name for one in line.names}
            elif isinstance(line, ast.Call) and ast.unparse(line.func) == "import_module":
                found |= {str(one.value) for one in line.args if isinstance(one, ast.Constant)}
    return {name for name in found if name.startswith(("daemon.", "estimator.")) and is_module(name)}


def exporter(name: str) -> str:
    """The module that is loaded where a name that the estimator exports is used."""
    return next(
        f"estimator.{module}" if module else f"estimator.{path}"
        for module, names in estimator.NAMES_OF.items()
        for path in names.split()
        if path.rpartition(".")[2] == name
    )


def is_module(name: str) -> bool:
    place = ROOT / name.replace(".", "/")
    return place.with_suffix(".py").is_file() or place.is_dir()


@pytest.mark.parametrize("lights", EXCEPT)
def test_what_a_daemon_loads_while_it_drives_has_no_kernel(lights: str) -> None:
    """States and dumps of a recorder, maps: a kernel among them would be compiled then, at the first start ever."""
    names = imported_inside_functions()
    assert names >= {
        "daemon.recording.checkpoint",
        "daemon.recording.state_file",
        "estimator.mapping.live_grid",
        *EXCEPT[lights],
    }
    command = [sys.executable, "-c", LATE, lights, *sorted(names - EXCEPT[lights].keys())]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
