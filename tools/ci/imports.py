"""The import graph of a source tree, read with `ast`: no module of the tree is loaded."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Final

NOTHING: Final = ast.Module(body=[], type_ignores=[])


def module_name(path: str) -> str:
    """Dotted name of a module: ``a.b`` for ``a/b.py`` and for ``a/b/__init__.py``."""
    return ".".join(PurePosixPath(path).with_suffix("").parts).removesuffix(".__init__")


def is_test(path: str) -> bool:
    """Whether pytest collects the file."""
    name = PurePosixPath(path).name
    return name.startswith("test_") and name.endswith(".py")


@dataclass(frozen=True, slots=True)
class Facts:
    """What one file names.

    Attributes:
        modules: dotted names that it imports, at any depth; attributes of modules are among them.
        strings: its string constants.
    """

    modules: frozenset[str]
    strings: frozenset[str]


class Tree:
    """The Python files below a root folder.

    Attributes:
        root: the folder that holds the top-level packages. tests: paths of all test files, relative to it.
        facts: what a file names, by its path relative to the root.
    """

    def __init__(self, root: Path) -> None:
        found = (path.relative_to(root).as_posix() for path in (root / "tests").rglob("test_*.py"))
        self.root: Final = root
        self.tests: Final = sorted(found)
        self.facts: Final = cache(self._facts)
        self._exports: Final = cache(self._names_of_face)

    def with_helpers(self, path: str) -> frozenset[str]:
        """Modules that a test file imports itself or through helper modules in ``tests``."""
        found: set[str] = set()
        waiting = [path]
        while waiting:
            new = self.facts(waiting.pop()).modules - found
            found |= new
            waiting += [helper for name in new if (helper := self._helper(name))]
        return frozenset(found)

    def _helper(self, name: str) -> str:
        """Path of a module in ``tests`` that is no test file; empty for anything else."""
        path = f"{name.replace('.', '/')}.py"
        return path if name.startswith("tests.") and not is_test(path) and (self.root / path).is_file() else ""

    def _facts(self, path: str) -> Facts:
        nodes = list(ast.walk(self._parse(path)))
        strings = (node.value for node in nodes if isinstance(node, ast.Constant) and isinstance(node.value, str))
        return Facts(frozenset(self._modules(nodes)), frozenset(strings))

    def _parse(self, path: str) -> ast.Module:
        """The syntax tree; an empty one for a file that is gone or damaged, about which pytest has better words."""
        try:
            return ast.parse((self.root / path).read_bytes())
        except (OSError, SyntaxError, ValueError):
            return NOTHING

    def _modules(self, nodes: list[ast.AST]) -> Iterator[str]:
        for node in nodes:
            if isinstance(node, ast.Import):
                yield from (alias.name for alias in node.names)
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                for alias in node.names:
                    yield from self._reached(node.module, alias.name)

    def _reached(self, module: str, name: str) -> Iterator[str]:
        """A module, its possible submodule, and the module from which a package's ``__init__`` takes the name."""
        seen: set[tuple[str, str]] = set()
        at: tuple[str, str] | None = (module, name)
        while at is not None and at not in seen:
            seen.add(at)
            yield at[0]
            yield f"{at[0]}.{at[1]}"
            at = self._exports(at[0]).get(at[1])

    def _names_of_face(self, package: str) -> dict[str, tuple[str, str]]:
        """By name that a package's ``__init__`` imports: the module it comes from and its name there."""
        tree = self._parse(f"{package.replace('.', '/')}/__init__.py")
        return {
            alias.asname or alias.name: (node.module, alias.name)
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module and not node.level
            for alias in node.names
        }
