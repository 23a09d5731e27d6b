"""The schema of states follows from the dataclasses: each field has a type that a state can hold."""

import ast
import collections.abc
import inspect
import sys
import types
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, is_dataclass
from enum import Enum
from importlib import import_module
from pathlib import Path
from typing import Any, Protocol, Union, get_args, get_origin, get_type_hints
from weakref import WeakSet

import msgspec
import numpy as np
import pytest

from daemon.recording import state_schema
from daemon.recording.state_schema import UnknownName, class_of, is_named_tuple, members, name_of
from estimator import JOB_FUNCTIONS, State, pipeline

LEAVES = (types.NoneType, bool, int, float, str, bytes, object, np.ndarray, np.generic)
CONTAINERS = (list, tuple, set, frozenset, dict, deque, WeakSet, types.UnionType, Union)
ABSTRACT = (collections.abc.Sequence, collections.abc.Mapping, collections.abc.Iterable, collections.abc.Collection)
FUNCTIONS = {"State.journal", "Settings.match", "Settings.light_pose", "Job.run", "Pending.apply"}
"""Fields that are functions: the journal is left out, the matcher has a name, the others are descriptions of jobs."""


def unchecked_imports(module: types.ModuleType) -> dict[str, object]:
    """The names that a module imports for type checkers only."""
    found: dict[str, object] = {}
    for node in ast.parse(Path(str(module.__file__)).read_text()).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for one in node.body:
                if isinstance(one, ast.ImportFrom):
                    source = import_module(str(one.module))
                    found |= {alias.asname or alias.name: getattr(source, alias.name) for alias in one.names}
    return found


def hints_of(kind: type) -> dict[str, Any]:
    names: dict[str, Any] = {}
    for base in kind.__mro__:
        module = sys.modules[base.__module__]
        names |= {**unchecked_imports(module), **vars(module)} if base.__module__.split(".")[0] != "builtins" else {}
    return get_type_hints(kind, localns=names)


def wrong(kind: type) -> Iterator[str]:
    """The fields of all classes that can be reached, if a state cannot hold them."""
    seen, waiting = {kind}, [kind]
    while waiting:
        one = waiting.pop()
        for field, hint in hints_of(one).items():
            name = f"{one.__name__}.{field}"
            for leaf in parts_of(hint):
                if leaf in seen or name in FUNCTIONS:
                    continue
                if not can_hold(leaf):
                    yield f"{name}: {leaf}"
                elif isinstance(leaf, type) and (is_dataclass(leaf) or is_named_tuple(leaf) or is_struct(leaf)):
                    seen.add(leaf)
                    waiting.append(leaf)


def is_struct(kind: type) -> bool:
    return issubclass(kind, msgspec.Struct)


def parts_of(hint: Any) -> Iterator[Any]:
    """The types that a hint consists of, without containers."""
    origin = get_origin(hint)
    if origin is np.ndarray or origin is type or str(hint).startswith("typing.ClassVar"):
        return
    if origin in (*CONTAINERS, *ABSTRACT):
        for part in get_args(hint):
            yield from parts_of(part)
    elif origin is not None:
        yield origin
    elif hint is not Ellipsis:
        yield hint


def can_hold(leaf: Any) -> bool:
    if leaf is Any or leaf in (*LEAVES, *CONTAINERS, *ABSTRACT) or not isinstance(leaf, type):
        return leaf is Any or leaf in (*LEAVES, *CONTAINERS, *ABSTRACT)
    if issubclass(leaf, np.generic | np.ndarray):
        return True
    try:
        return class_of(name_of(leaf)) is leaf or Protocol in leaf.__mro__
    except UnknownName:
        return False


def test_every_field_of_the_estimators_state_can_be_held() -> None:
    assert list(wrong(State)) == []


def test_every_field_of_the_cycles_parts_can_be_held() -> None:
    kinds = [one for one in members("cycle").values() if isinstance(one, type) and is_dataclass(one)]
    assert len(kinds) > 5
    assert [found for kind in kinds for found in wrong(kind)] == []


@dataclass
class Unfit:
    """Has fields that no state can hold."""

    good: int
    path: Path
    later: collections.abc.Callable[[], int]
    made: collections.abc.Iterator[int]


def test_a_field_that_no_state_can_hold_is_found() -> None:
    found = " ".join(wrong(Unfit))
    assert "good" not in found
    assert all(f"Unfit.{name}" in found for name in ("path", "later", "made"))


@pytest.mark.parametrize("group", [*state_schema.PACKAGES, *state_schema.MODULES])
def test_each_group_has_names_of_its_own_which_lead_back(group: str) -> None:
    """Two classes of one package with one name could not be told apart: give one of them another."""
    found = members(group)
    assert found
    for name, one in found.items():
        if isinstance(one, type):
            assert class_of(f"{group}.{name}") is one
            assert name_of(one) == f"{group}.{name}"


def test_every_job_is_a_call_of_marked_functions() -> None:
    """`JobQueue.ask` takes partial calls; each of their functions has a mark, and so a name."""
    asked = 0
    for path in sorted(Path(str(pipeline.__file__)).parent.rglob("*.py")):
        text = path.read_text()
        for node in ast.walk(ast.parse(text)):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr == "ask"):
                continue
            asked += 1
            for given in node.args[1:3]:
                assert isinstance(given, ast.Name) or ast.unparse(given).startswith("partial("), ast.unparse(node)
    assert asked >= 6
    assert len(JOB_FUNCTIONS) >= asked
    assert all(inspect.isfunction(one) and "<" not in one.__qualname__ for one in JOB_FUNCTIONS)


def test_enumerations_have_values_that_a_file_holds() -> None:
    for group in (*state_schema.PACKAGES, *state_schema.MODULES):
        for one in members(group).values():
            if isinstance(one, type) and issubclass(one, Enum):
                assert all(isinstance(member.value, int | str) for member in one), one
