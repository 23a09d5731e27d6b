"""Which kernels Python calls, and that a start does without the machine code of the others."""

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from estimator.numerics.symmetric3 import solve3

ROOT = Path(__file__).parents[3]
ROOMS = ("estimator", "daemon", "hal", "taps")


def decorator(node: ast.AST) -> ast.Call | None:
    if isinstance(node, ast.FunctionDef):
        for one in node.decorator_list:
            if isinstance(one, ast.Call) and isinstance(one.func, ast.Name) and one.func.id == "kernel":
                return one
    return None


def outside_kernels(node: ast.AST) -> Iterator[ast.AST]:
    """All nodes below, without those of kernels."""
    yield node
    for child in ast.iter_child_nodes(node):
        if decorator(child) is None:
            yield from outside_kernels(child)


def dotted(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts)


def used(path: Path, tree: ast.Module) -> Iterator[str]:
    """What Python code of a file names, as ``module.name``."""
    here = dotted(path)
    nodes = list(outside_kernels(tree))
    known = {
        alias.asname or alias.name: f"{node.module}.{alias.name}"
        for node in nodes
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    for node in nodes:
        if isinstance(node, ast.Name):
            yield known.get(node.id, f"{here}.{node.id}")
        elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            yield f"{known.get(node.value.id, node.value.id)}.{node.attr}"


def test_those_that_only_kernels_call_say_so_and_no_others_do() -> None:
    trees = {path: ast.parse(path.read_text()) for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    of_python = {name for path, tree in trees.items() for name in used(path, tree)}
    inner, outer = set(), set()
    for path, tree in trees.items():
        for node in tree.body:
            if (call := decorator(node)) is not None:
                words = {keyword.arg for keyword in call.keywords if ast.literal_eval(keyword.value)}
                assert isinstance(node, ast.FunctionDef)
                (inner if words & {"inner", "inline"} else outer).add(f"{dotted(path)}.{node.name}")
    assert len(outer) > 50
    assert sorted(inner & of_python) == []
    assert sorted(outer - of_python) == []


@pytest.mark.jit
def test_an_inner_kernel_is_loaded_when_it_is_called_and_knows_its_one_signature() -> None:
    code = (
        "import estimator.numerics.symmetric3 as l, numpy as np\n"
        "print(len(l.solve3.overloads), len(l.invert3.overloads))\n"
        "x = np.zeros(3); l.solve3(np.eye(3), np.ones(3), x)\n"
        "print(len(l.solve3.overloads), x.tolist())\n"
    )
    for said in ("", "0 1\n1 [1.0, 1.0, 1.0]\n"):  # the first compiles them all, where nobody has done so
        done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
        assert said in done.stdout
    solve3(np.eye(3), np.ones(3), np.zeros(3))
    with pytest.raises(TypeError, match="No matching definition"):
        solve3(np.eye(3, dtype=np.float32), np.ones(3), np.zeros(3))
