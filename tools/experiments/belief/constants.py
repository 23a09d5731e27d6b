"""The constants that decide belief: each number in the parts that judge the place, with its meaning and its file.

Read from the sources: numbers that a module, or a class of settings, binds to a name. A group that is bound at once
counts as many as it has names. Layouts of arrays, optics of a lamp and the reading of surveys are left out.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from tools.ci.figures import bounded
from tools.experiments.support.report import COMMAND, ROOT, Report, Table, Work

PARTS: Final = ("estimator/relocalisation", "estimator/fusion", "estimator/light_filter", "daemon/integrity")
LEFT_OUT: Final = frozenset({"state_vector", "lambertian", "survey", "residual_map", "residual_lookup"})
"""Modules whose numbers describe data."""
MOST: Final = 60
Row = tuple[str, str, str, str]
"""Name, value as written, meaning, file."""


def constants(part: str, root: Path = ROOT) -> list[Row]:
    """Those of a folder."""
    found = []
    for path in sorted((root / part).glob("*.py")):
        body = ast.parse(path.read_text()).body if path.stem not in LEFT_OUT else []
        classes = [
            node for node in body if isinstance(node, ast.ClassDef) and node.name.endswith(("Settings", "Errors"))
        ]
        for owner, nodes in (("", body), *((f"{node.name}.", node.body) for node in classes)):
            for at, name, value in bound(nodes):
                if owner or name.isupper():
                    found.append((owner + name, ast.unparse(value), meaning(nodes, at, name), path.name))
    return found


def bound(body: list[ast.stmt]) -> Iterator[tuple[int, str, ast.expr]]:
    """Place in the body, name and value of each number that is bound there."""
    for at, node in enumerate(body):
        if isinstance(node, ast.AnnAssign | ast.Assign) and node.value is not None:
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            pairs = [(target, node.value)]
            if isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple):
                pairs = list(zip(target.elts, node.value.elts, strict=True))
            for each, value in pairs:
                if isinstance(each, ast.Name) and number(value):
                    yield at, each.id, value


def number(value: ast.expr) -> bool:
    """Whether an expression is a number, or an array of numbers, that is written here."""
    nodes = list(ast.walk(value))
    calls = {ast.unparse(node.func) for node in nodes if isinstance(node, ast.Call)}
    written = [type(node.value) for node in nodes if isinstance(node, ast.Constant)]
    others = (ast.Dict, ast.Lambda, ast.Compare, ast.JoinedStr, ast.ListComp)
    return (
        bool({int, float} & set(written))
        and "zeros" not in ast.unparse(value)
        and str not in written
        and not any(isinstance(node, others) for node in nodes)
        and all(call.startswith(("np.", "math.", "float", "int")) for call in calls)
    )


def meaning(body: list[ast.stmt], at: int, name: str) -> str:
    """Text of the class on an attribute, or the docstring after the assignment, or after the group it stands in."""
    documented = [
        node.value.value for node in body if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    ]
    for text in map(str, documented[:1] if name.islower() else []):
        found = re.search(
            rf"(?:^|\n|[.;] )\s*(?:\w+, )*{name}(?:, \w+)*: (.*?)(?:(?:[.;]|\n) *\w+(?:, \w+)*: |\Z)", text, re.S
        )
        if found:
            return " ".join(found[1].split())
    for node in body[at + 1 :]:
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            return " ".join(str(node.value.value).split())
        if not isinstance(node, ast.Assign | ast.AnnAssign):
            break
    return ""


def run(quick: bool, work: Work) -> Report:
    """Count and list them."""
    found = {part: constants(part) for part in PARTS}
    every = [row for rows in found.values() for row in rows]
    command = f"{COMMAND} constants"
    figures = (
        bounded("constants that decide belief", len(every), "", f"<= {MOST}", command),
        bounded("constants without a meaning beside them", sum(not row[2] for row in every), "", "<= 0", command),
    )
    head = ("constant", "value", "meaning, unit, source", "file")
    return Report(figures, tuple(Table(f"{part}: {len(rows)}", head, tuple(rows)) for part, rows in found.items()))
