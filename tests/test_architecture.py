"""The architecture as a test: which module may import which, and how large a folder and a file may be.

A room is a folder of the top level, an entry is a package or a module directly in it. An import counts wherever it
stands: at the top of a module, inside a function, or under TYPE_CHECKING.
"""

from __future__ import annotations

import ast
import functools
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

OURS = {"daemon", "hal", "estimator", "taps", "tools", "tests"}
MAY_IMPORT = {
    "estimator": {"estimator"},
    "hal": {"hal"},
    "daemon": {"daemon", "hal", "estimator"},
    "taps": {"taps", "daemon", "hal", "estimator"},
}
"""The rooms that a room's modules may import; ``tools`` and ``tests`` import anything."""

ORDER = {
    "estimator": (
        *("lazy_exports", "numerics", "cdma", "measurements", "result", "job_queue", "light_filter", "scan_matching"),
        *("fusion", "mapping", "relocalisation", "state", "stored_map", "match_entry", "commands", "pipeline"),
        *("calibration", "paper"),
    ),
    "hal": (
        *("errors", "clock", "blocking_calls", "timerfd", "run_server", "lidar", "adc", "odometry", "imu"),
        *("net", "port", "bus", "hokuyo", "photodiode", "registry", "replay", "fake"),
    ),
    "daemon": (
        *("system", "config", "snapshot", "health", "devices", "maps", "integrity", "runtime", "recording"),
        *("publish", "environment", "app", "replay", "diagnosis", "commissioning", "cli", "__main__"),
    ),
    "taps": (
        *("stream", "access_guard", "zenoh_session", "ros", "foxglove", "mcap", "view", "metrics"),
        "fleet",
    ),
    "tools": ("ci", "clients", "sim", "relations", "demo", "bench", "experiments", "soak", "docs"),
}
"""The entries of each room in order. A module imports from its own entry and from those to its left.

The room's ``__init__`` is its face for other rooms: it may import everything in the room, and nothing there imports it.
"""

FACES = {"estimator", "estimator.calibration", "estimator.paper"}
"""All that other rooms of the installed program import of the estimator."""

MOST_FILES = 20
MOST_LINES = 400
MOST_FOLDERS_OF_DAEMON = 13
SOURCES = {".py", ".js", ".css", ".html", ".c", ".cpp", ".h", ".sh"}
SIZED = (*sorted(OURS), "systemd")

ESTIMATOR_NEVER = {
    *("os", "pathlib", "io", "subprocess", "logging"),
    *("asyncio", "threading", "time", "socket", "serial", "random"),
}
ESTIMATOR_EXCEPTIONS = {"jit_cache.py", "jit_cache_file.py"}  # find the kernel cache, and read and write its files

Graph = Mapping[str, set[str]]


def sources(room: str, root: Path = ROOT) -> list[Path]:
    return sorted((root / room).rglob("*.py"))


@functools.cache
def imports_of(path: Path) -> frozenset[tuple[str, str]]:
    """Every import of a file, as the module and the name taken from it ("" for a plain ``import``)."""
    found: set[tuple[str, str]] = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            found |= {(alias.name, "") for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found |= {(node.module or "", alias.name) for alias in node.names}
    return frozenset(found)


def names_of(path: Path) -> set[str]:
    """Every name that a file imports, with the modules the names are taken from."""
    return {full for module, name in imports_of(path) for full in (module, f"{module}.{name}" if name else module)}


def tops_of(path: Path) -> set[str]:
    """The top-level packages that a file imports."""
    return {module.split(".")[0] for module, _ in imports_of(path)}


@functools.cache
def modules_of(room: str, root: Path = ROOT) -> dict[str, Path]:
    """The files of a room by dotted name; a package's name stands for its ``__init__``."""
    dotted = {".".join(path.relative_to(root).with_suffix("").parts): path for path in sources(room, root)}
    return {name.removesuffix(".__init__"): path for name, path in dotted.items()}


def targets_of(path: Path, modules: Iterable[str]) -> set[str]:
    """The modules among ``modules`` that a file imports; a name taken from a package counts as its face."""
    resolved = {full if (full := f"{module}.{name}") in modules else module for module, name in imports_of(path)}
    return resolved & set(modules)


def graph_of(room: str, root: Path = ROOT) -> Graph:
    """Module to the modules of the same room that it imports."""
    modules = modules_of(room, root)
    return {name: targets_of(path, modules) - {name} for name, path in modules.items()}


def circles_in(graph: Graph) -> list[str]:
    """The nodes that are on a circle or on a way from one circle to another; empty where there is no circle."""
    left = {node: set(targets) for node, targets in graph.items()}
    while True:
        used = {target for targets in left.values() for target in targets}
        ends = {node for node, targets in left.items() if not targets or node not in used}
        if not ends:
            return sorted(left)
        left = {node: targets - ends for node, targets in left.items() if node not in ends}


def entry_of(module: str, depth: int = 1) -> str:
    """The part of a dotted name that is the entry of its room; the room itself for its ``__init__``."""
    return (module.split(".")[: depth + 1] or [module])[-1]


def upward(room: str, order: tuple[str, ...], root: Path = ROOT) -> list[str]:
    """Imports of a room that do not go to the left in the order, one line each."""
    rank = {entry: place for place, entry in enumerate((*order, room))}
    return [
        f"{module} imports {target}"
        for module, targets in sorted(graph_of(room, root).items())
        for target in sorted(targets)
        if rank.get(entry_of(target), 0) > rank.get(entry_of(module), 0)
    ]


def sibling_graphs(room: str, root: Path = ROOT) -> dict[str, Graph]:
    """For each folder of a room: the imports between the modules and packages directly in it.

    The folder's own ``__init__`` is left out: a face imports what is below it.
    """
    graphs: dict[str, dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for module, targets in graph_of(room, root).items():
        for target in targets:
            parts = tuple(zip(module.split("."), target.split("."), strict=False))
            shared = next((i for i, (a, b) in enumerate(parts) if a != b), None)
            if shared is not None:
                graphs[".".join(module.split(".")[:shared])][parts[shared][0]].add(parts[shared][1])
    return {
        folder: {node: set(graph.get(node, ())) for node in {*graph, *(t for ts in graph.values() for t in ts)}}
        for folder, graph in graphs.items()
    }


# rooms


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_one_way_rule(room: str) -> None:
    assert sources(room)
    for path in sources(room):
        wrong = (tops_of(path) & OURS) - MAY_IMPORT[room]
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


@pytest.mark.parametrize("room", ["daemon", "taps"])
def test_of_the_estimator_only_its_face_is_imported(room: str) -> None:
    modules = modules_of("estimator")
    wrong = [
        f"{path.relative_to(ROOT)} imports {target}"
        for path in sources(room)
        for target in sorted(targets_of(path, modules) - FACES)
    ]
    assert not wrong, "\n".join(wrong)


def test_estimator_is_numbers_only() -> None:
    for path in sources("estimator"):
        if path.name not in ESTIMATOR_EXCEPTIONS:
            tops = tops_of(path)
            assert not tops & ESTIMATOR_NEVER, f"{path.name} imports {sorted(tops & ESTIMATOR_NEVER)}"


def test_fake_and_driver_share_no_codec() -> None:
    for path in sources("hal"):
        names = names_of(path)
        relative = path.relative_to(ROOT)
        if relative.parts[1] == "fake":
            bad = {n for n in names if n.startswith(("hal.hokuyo", "hal.photodiode"))}
        else:
            bad = {n for n in names if n.startswith("hal.fake")}
        assert not bad, f"{relative} imports {sorted(bad)}"


@pytest.mark.parametrize("words", [["--help"], ["status", "--help"], ["check", "--help"]])
def test_commands_without_numbers_do_not_load_numba(words: list[str]) -> None:
    code = (
        f"import sys\nfrom daemon.cli.parser import main\ntry:\n    main({words!r})\nexcept SystemExit:\n    pass\n"
        "assert 'numba' not in sys.modules and 'numpy' not in sys.modules"
    )
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# packages and modules


@pytest.mark.parametrize("room", sorted(ORDER))
def test_every_entry_has_its_place_in_the_order(room: str) -> None:
    entries = {entry_of(module) for module in modules_of(room)} - {room}
    assert entries == set(ORDER[room])


@pytest.mark.parametrize("room", sorted(ORDER))
def test_entries_import_only_from_those_before_them(room: str) -> None:
    wrong = upward(room, ORDER[room])
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("room", sorted(OURS))
def test_no_circle_among_modules(room: str) -> None:
    assert circles_in(graph_of(room)) == []


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_no_circle_among_the_packages_of_any_folder(room: str) -> None:
    circles = {folder: circles_in(graph) for folder, graph in sibling_graphs(room).items()}
    assert not {folder: circle for folder, circle in circles.items() if circle}


# sizes


def files_of(room: str) -> list[Path]:
    return [path for path in sorted((ROOT / room).rglob("*")) if path.is_file() and path.suffix in SOURCES]


@pytest.mark.parametrize("room", SIZED)
def test_folders_are_small(room: str) -> None:
    counts: dict[Path, int] = defaultdict(int)
    for path in files_of(room):
        counts[path.parent.relative_to(ROOT)] += path.name != "__init__.py"
    assert counts
    assert not {str(folder): count for folder, count in counts.items() if count > MOST_FILES}


@pytest.mark.parametrize("room", SIZED)
def test_files_are_short(room: str) -> None:
    lines = {str(path.relative_to(ROOT)): len(path.read_bytes().splitlines()) for path in files_of(room)}
    assert lines
    assert not {name: count for name, count in lines.items() if count > MOST_LINES}


def test_daemon_has_few_folders() -> None:
    folders = {path.parent for path in (ROOT / "daemon").glob("*/__init__.py")}
    assert 0 < len(folders) <= MOST_FOLDERS_OF_DAEMON


# the rules notice what they forbid


def tree(root: Path, files: Mapping[str, str]) -> Path:
    for name, text in files.items():
        path = root / "room" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


LAZY = "def f():\n    from room.b.upper import g\n"
TYPING = "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    from room.b import upper\n"


@pytest.mark.parametrize("text", [LAZY, TYPING, "import room.b.upper\n"])
def test_an_upward_import_and_the_circle_it_makes_are_found(tmp_path: Path, text: str) -> None:
    root = tree(tmp_path, {"a/lower.py": text, "a/other.py": "", "b/upper.py": "import room.a.lower\n"})
    assert upward("room", ("a", "b"), root) == ["room.a.lower imports room.b.upper"]
    assert circles_in(graph_of("room", root)) == ["room.a.lower", "room.b.upper"]


def test_packages_that_import_each_other_without_a_circle_of_modules_are_found(tmp_path: Path) -> None:
    files = {"a/one.py": "import room.b.one\n", "b/one.py": "", "b/two.py": "import room.a.two\n", "a/two.py": ""}
    root = tree(tmp_path, files)
    assert circles_in(graph_of("room", root)) == []
    assert circles_in(sibling_graphs("room", root)["room"]) == ["a", "b"]


def test_a_module_that_imports_the_face_above_it_is_found(tmp_path: Path) -> None:
    face = "def __getattr__(name):\n    import room.a.lower\n"
    root = tree(tmp_path, {"__init__.py": face, "a/lower.py": "from room import name\n"})
    assert upward("room", ("a",), root) == ["room.a.lower imports room"]
    assert circles_in(graph_of("room", root)) == ["room", "room.a.lower"]


def test_what_only_leads_to_a_circle_is_not_named(tmp_path: Path) -> None:
    files = {"a.py": "import room.b\n", "b.py": "import room.c\n", "c.py": "import room.b, room.d\n", "d.py": ""}
    assert circles_in(graph_of("room", tree(tmp_path, files))) == ["room.b", "room.c"]
