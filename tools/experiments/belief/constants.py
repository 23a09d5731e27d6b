"""The constants that decide belief: each number in the parts that judge the place, with its meaning and its file.

Read from the sources: numbers that a module or a settings class binds to a name. A group that is bound at once counts
as many constants as it has names. Layouts of arrays (`state_vector.py`) and the optics of a lamp are left out.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tools.ci.figures import bounded
from tools.experiments.support.report import COMMAND, ROOT, Report, Table, Work

PARTS: Final = ("estimator/relocalisation", "estimator/fusion", "estimator/light_filter", "daemon/integrity")
LEFT_OUT: Final = frozenset({"state_vector", "lambertian", "survey", "residual_map", "residual_lookup"})
"""Modules of array layouts, optics and stored maps: their numbers describe data and decide nothing."""
MOST: Final = 60
NAME: Final = re.compile(r"_?[A-Z][A-Z0-9_]*$")


@dataclass(frozen=True, slots=True)
class Constant:
    """One constant: its name (with the class it is a default of), its value as written, meaning, file and line."""

    name: str
    value: str
    meaning: str
    file: str
    line: int

    @property
    def number(self) -> bool:
        """Whether the value is written with a number."""
        return any(
            isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool)
            for node in ast.walk(ast.parse(self.value, mode="eval"))
        )


def found(root: Path = ROOT, parts: tuple[str, ...] = PARTS) -> list[Constant]:
    """All of them, file by file."""
    paths = [path for part in parts for path in sorted((root / part).glob("*.py")) if path.stem not in LEFT_OUT]
    return [one for path in paths for one in of_file(path, str(path.relative_to(root))) if one.number]


def of_file(path: Path, name: str) -> Iterator[Constant]:
    """Constants of a module, and the defaults of its settings classes."""
    tree = ast.parse(path.read_text())
    yield from _of_body(tree.body, name, "", {})
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and node.name.endswith(("Settings", "Errors")):
            yield from _of_body(node.body, name, f"{node.name}.", _attributes(ast.get_docstring(node) or ""))


def _of_body(body: list[ast.stmt], file: str, owner: str, told: dict[str, str]) -> Iterator[Constant]:
    """Constants of a module or class; a docstring explains all that are bound right above it."""
    for at, node in enumerate(body):
        targets = (
            node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        )
        value = node.value if isinstance(node, ast.Assign | ast.AnnAssign) else None
        if value is None or len(targets) != 1:
            continue
        for name, each in _bound(targets[0], value):
            if owner or NAME.match(name):
                yield Constant(owner + name, ast.unparse(each), told.get(name) or _meaning(body, at), file, node.lineno)


def _bound(target: ast.expr, value: ast.expr) -> Iterator[tuple[str, ast.expr]]:
    """Names and what each is bound to."""
    if isinstance(target, ast.Name):
        if isinstance(value, ast.Constant | ast.BinOp | ast.UnaryOp | ast.Tuple | ast.Call) and not _built(value):
            yield target.id, value
    elif isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
        for each, part in zip(target.elts, value.elts, strict=True):
            yield from _bound(each, part)


def _built(value: ast.expr) -> bool:
    """Whether a call makes anything but a number: only those of numpy and math give one."""
    calls = [node for node in ast.walk(value) if isinstance(node, ast.Call)]
    return any(not ast.unparse(call.func).startswith(("np.", "math.", "float", "int")) for call in calls)


def _meaning(body: list[ast.stmt], at: int) -> str:
    """The docstring that follows a constant or the group it stands in."""
    for node in body[at + 1 :]:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            return " ".join(node.value.value.split())
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            return ""
    return ""


def _attributes(docstring: str) -> dict[str, str]:
    """Meaning of each attribute of a class from the section of its docstring."""
    text = " ".join(docstring.partition("Attributes:")[2].split())
    parts = re.split(r"(?:^|(?<=[.;] ))((?:[a-z_]+, )*[a-z_]+): ", text)
    pairs = zip(parts[1::2], parts[2::2], strict=False)
    return {name: meaning.strip() for names, meaning in pairs for name in names.split(", ")}


def run(quick: bool, work: Work) -> Report:
    """Count and list them."""
    every = found()
    tables = []
    for part in PARTS:
        rows = [
            (one.name, one.value, one.meaning, f"{Path(one.file).name}:{one.line}")
            for one in every
            if one.file.startswith(part)
        ]
        tables.append(
            Table(f"{part}: {len(rows)}", ("constant", "value", "meaning, unit and source", "where"), tuple(rows))
        )
    unexplained = sum(not one.meaning for one in every)
    figures = (
        bounded("constants that decide belief", len(every), "", f"<= {MOST}", f"{COMMAND} constants"),
        bounded("constants without a meaning beside them", unexplained, "", "<= 0", f"{COMMAND} constants"),
    )
    return Report(figures, tuple(tables))
