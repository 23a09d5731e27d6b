"""The one-way rule between rooms, and what each room may import from outside."""

from __future__ import annotations

import ast
import subprocess
import sys
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
ESTIMATOR_NEVER = {
    *("os", "pathlib", "io", "subprocess", "logging"),
    *("asyncio", "threading", "time", "socket", "serial", "random"),
}
ESTIMATOR_EXCEPTION = "jit_cache.py"  # finds the kernel cache once, at import


def imports_of(path: Path) -> set[str]:
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(), str(path))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative import"
            found.add(node.module or "")
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def sources(room: str) -> list[Path]:
    return sorted((ROOT / room).rglob("*.py"))


@pytest.mark.parametrize("room", sorted(MAY_IMPORT))
def test_one_way_rule(room: str) -> None:
    assert sources(room)
    for path in sources(room):
        tops = {name.split(".")[0] for name in imports_of(path)}
        wrong = (tops & OURS) - MAY_IMPORT[room]
        assert not wrong, f"{path.relative_to(ROOT)} imports {sorted(wrong)}"


def test_estimator_is_numbers_only() -> None:
    for path in sources("estimator"):
        if path.name != ESTIMATOR_EXCEPTION:
            tops = {name.split(".")[0] for name in imports_of(path)}
            assert not tops & ESTIMATOR_NEVER, f"{path.name} imports {sorted(tops & ESTIMATOR_NEVER)}"


def test_fake_and_driver_share_no_codec() -> None:
    for path in sources("hal"):
        names = imports_of(path)
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


def circle_in(room: str) -> list[str]:
    """Modules of a room that import each other in a circle, also where the import waits inside a function."""
    modules = {".".join(p.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): p for p in sources(room)}
    graph = {name: (imports_of(path) & set(modules)) - {name} for name, path in modules.items()}
    while leaves := [name for name, needed in graph.items() if not needed]:
        graph = {name: needed - set(leaves) for name, needed in graph.items() if name not in leaves}
    return sorted(graph)


def test_no_circles_among_devices() -> None:
    assert circle_in("hal") == []
