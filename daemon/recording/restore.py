"""Reader of checkpoints: builds the objects of a state from the nodes of its file.

A checkpoint may come from anywhere, for example by mail from a customer's robot. The reader therefore makes nothing but
containers, arrays, objects of the schema's classes with exactly the fields of these, and descriptions of jobs. It calls
no function. Memory and time are proportional to the file, whose size `daemon.recording.state_file` limits: every size
is checked before it is used. `daemon.recording.checkpoint` writes the files.
"""

from __future__ import annotations

import inspect
import types
from collections import deque
from collections.abc import Callable, Iterable
from enum import Enum
from functools import partial
from math import prod
from typing import Any, Final, NamedTuple, cast
from weakref import WeakSet

import msgspec
import numpy as np

from daemon.recording.state_schema import (
    CONTAINERS,
    PLAIN,
    Array,
    Blob,
    Call,
    Kind,
    Many,
    Member,
    Node,
    Record,
    Ref,
    Table,
    UnknownName,
    Value,
    class_of,
    fields_of,
    function_of,
    is_enumeration,
    is_named_tuple,
)
from estimator import State

MOST_NODES: Final = 4_000_000
"""Largest number of nodes; the state of a map of 10000 submaps has a million."""
DEEPEST: Final = 100
"""Deepest nesting of tuples in one another."""
MOST_WITHIN: Final = 1000
"""Most values within one key of a dict or element of a set: its hash is computed from all of them."""

_REFUSED: Final = (AttributeError, ImportError, LookupError, TypeError, ValueError, ArithmeticError, UnknownName)
"""Exceptions that a damaged or forged state may raise."""
_NOT_THERE: Final = object()
_FORMS: Final = frozenset(CONTAINERS.values())


class CannotRestore(Exception):
    """The checkpoint was made by other software, or is damaged."""


class _Shape(NamedTuple):
    """A class with the names of the fields that its records have."""

    kind: type
    names: tuple[str, ...]


def restore(nodes: Iterable[Node]) -> tuple[State, dict[str, Any]]:
    """Returns the state and the rest, as they were captured.

    Raises:
        CannotRestore: other software captured them, or they are damaged.
    """
    try:
        everything = build(nodes)
        state, rest = cast(Any, everything)["state"], cast(Any, everything)["rest"]
        if type(state) is not State or type(rest) is not dict:
            raise ValueError("it holds no checkpoint")
        for place, keys in state.map.places.items():
            state.map.places[place] = list(keys)
    except _REFUSED as error:
        raise CannotRestore(f"made by another version, or damaged: {error}") from error
    except (MemoryError, RecursionError) as error:
        raise CannotRestore(f"it is too large: {error}") from error
    return state, rest


def build(nodes: Iterable[Node]) -> object:
    """Returns the object of node 0.

    Raises:
        ValueError, TypeError, LookupError, UnknownName: the nodes are damaged, or of another schema.
    """
    kept: list[Node] = []
    for node in nodes:
        if len(kept) >= MOST_NODES:
            raise ValueError(f"more than {MOST_NODES} nodes")
        kept.append(node)
    return _Builder(kept).built()


class _Builder:
    """Builds the objects of all nodes.

    What can be changed is made empty at first, so that it can be referred to. What cannot (tuples, jobs) is made after
    its parts. Then lists and records are filled, and at last sets and dicts, for which hashes are needed.
    """

    def __init__(self, nodes: list[Node]) -> None:
        self._nodes = nodes
        self._made: list[Any] = [_NOT_THERE] * len(nodes)

    def built(self) -> object:
        """Returns the object of node 0."""
        made, nodes = self._made, self._nodes
        for number, node in enumerate(nodes):
            if isinstance(node, Kind):
                made[number] = _shape(node)
        for number, node in enumerate(nodes):
            if made[number] is _NOT_THERE:
                made[number] = self._begun(node)
        for number in range(len(nodes)):
            self._fixed(number, 0)
        hashed = [number for number, node in enumerate(nodes) if not self._filled(made[number], node)]
        for number in hashed:
            self._take_in(made[number], nodes[number])
        return self._value(Ref(0))

    def _begun(self, node: Node) -> object:
        """Returns a leaf, or an object to be filled; :data:`_NOT_THERE` for one whose parts are needed first."""
        match node:
            case Array():
                return _array(node)
            case Blob():
                return node.data
            case Member():
                return _member(node)
            case Call(given=None):
                return function_of(node.name)
            case Table():
                return {}
            case Record():
                shape = self._shape_of(node)
                return _NOT_THERE if _is_fixed(shape.kind) else _blank(shape.kind)
            case Many():
                return _container(node)
        return _NOT_THERE

    def _shape_of(self, node: Record) -> _Shape:
        shape = self._made[node.kind] if 0 <= node.kind < len(self._made) else None
        if not isinstance(shape, _Shape) or len(shape.names) != len(node.values):
            raise ValueError("a record without its class, or with other fields than that has")
        return shape

    def _value(self, value: Value) -> Any:
        if type(value) is not Ref:
            return value
        if not 0 <= value.node < len(self._made):
            raise ValueError(f"node {value.node} does not exist")
        made = self._made[value.node]
        if made is _NOT_THERE or isinstance(made, _Shape):
            raise ValueError(f"node {value.node} is not a value")
        return made

    def _values(self, values: Iterable[Value]) -> list[Any]:
        return list(map(self._value, values))

    def _fixed(self, number: int, depth: int) -> None:
        """Makes an object that cannot be changed, after its parts."""
        if self._made[number] is not _NOT_THERE:
            return
        if depth > DEEPEST:
            raise ValueError(f"tuples are nested deeper than {DEEPEST}")
        node = self._nodes[number]
        if isinstance(node, Many):
            parts = node.items
        elif isinstance(node, Call):
            parts = node.given or []
        else:
            parts = cast(Record, node).values
        for part in parts:
            if type(part) is Ref and 0 <= part.node < len(self._made):
                self._fixed(part.node, depth + 1)
        self._made[number] = self._frozen(node, self._values(parts))

    def _frozen(self, node: Node, parts: list[Any]) -> object:
        if isinstance(node, Many):
            return tuple(parts) if node.form == "tuple" else frozenset(map(_hashable, parts))
        if isinstance(node, Call):
            return partial(function_of(node.name), *parts)
        kind: Any = self._shape_of(cast(Record, node)).kind
        return kind._make(parts) if is_named_tuple(kind) else kind(*parts)

    def _filled(self, made: Any, node: Node) -> bool:
        """Fills a list, a deque or a record; False for what needs hashes."""
        if isinstance(node, Record):
            shape = self._shape_of(node)
            if not _is_fixed(shape.kind):
                for name, value in zip(shape.names, self._values(node.values), strict=True):
                    object.__setattr__(made, name, value)
        elif isinstance(node, Many) and node.form in ("list", "deque"):
            made.extend(self._values(node.items))
        else:
            return not (isinstance(node, Table) or (isinstance(node, Many) and node.form in ("set", "weakset")))
        return True

    def _take_in(self, made: Any, node: Node) -> None:
        """Fills a set or a dict."""
        if isinstance(node, Table):
            keys = map(_hashable, self._values(node.keys))
            made.update(zip(keys, self._values(node.values), strict=True))
            return
        for element in map(_hashable, self._values(cast(Many, node).items)):
            made.add(element)


def _shape(node: Kind) -> _Shape:
    """Returns the class of a node, whose fields must be those of this program."""
    kind = class_of(node.name)
    if is_enumeration(kind):
        raise ValueError(f"{node.name} has no records")
    names = fields_of(kind)
    if names is None:
        for name in node.fields:
            if not _is_attribute(kind, name):
                raise ValueError(f"{node.name} has no field {name!r}")
    elif names != node.fields:
        lacks = ", ".join(sorted(set(names) ^ set(node.fields))) or "their order"
        raise ValueError(f"{node.name} has other fields in this version: {lacks}")
    if len(set(node.fields)) != len(node.fields):
        raise ValueError(f"{node.name} has a field twice")
    return _Shape(kind, node.fields)


def _is_attribute(kind: type, name: str) -> bool:
    """True if objects of a class without declared fields may have an attribute; methods are none."""
    if issubclass(kind, BaseException) and name == "args":
        return True
    if not name.isidentifier() or name.startswith("__"):
        return False
    there = inspect.getattr_static(kind, name, _NOT_THERE)
    return there is _NOT_THERE or isinstance(there, types.MemberDescriptorType)


def _is_fixed(kind: type) -> bool:
    return is_named_tuple(kind) or issubclass(kind, msgspec.Struct)


def _blank(kind: type) -> object:
    return kind.__new__(kind) if issubclass(kind, BaseException) else object.__new__(kind)


def _container(node: Many) -> object:
    if node.form not in _FORMS:
        raise ValueError(f"{node.form!r} is not a container")
    if node.form in ("tuple", "frozenset"):
        return _NOT_THERE
    made: dict[str, Callable[[], object]] = {"list": list, "set": set, "weakset": WeakSet}
    return deque(maxlen=node.longest) if node.form == "deque" else made[node.form]()


def _member(node: Member) -> object:
    kind: Any = class_of(node.name)
    if not is_enumeration(kind):
        raise ValueError(f"{node.name} has no members")
    return kind(node.value)


def _array(node: Array) -> object:
    dtype = np.dtype(node.dtype)
    if dtype.kind not in PLAIN or not dtype.itemsize or dtype.names is not None or dtype.subdtype is not None:
        raise ValueError(f"arrays of {node.dtype!r} cannot be part of a checkpoint")
    if any(size < 0 for size in node.shape) or node.order not in ("C", "F"):
        raise ValueError(f"no array has the shape {node.shape}")
    if prod(node.shape) * dtype.itemsize != len(node.data) or (node.scalar and node.shape):
        raise ValueError(f"{len(node.data)} bytes for an array of {node.dtype} of shape {node.shape}")
    made = np.frombuffer(bytearray(node.data), dtype).reshape(node.shape, order="F" if node.order == "F" else "C")
    return made[()] if node.scalar else made


def _hashable(key: Any) -> Any:
    """Returns a key or element, if its hash takes a bounded time.

    Raises:
        ValueError: it is none, or too large.
    """
    if _weight(key, MOST_WITHIN) <= 0:
        raise ValueError("a key of a dict or an element of a set that is too large")
    return key


def _weight(key: Any, left: int) -> int:
    """Returns how many values of ``left`` are left after all within a key."""
    if isinstance(key, (tuple, frozenset)):
        for part in key:
            left = _weight(part, left - 1)
            if left <= 0:
                return 0
    elif not isinstance(key, _ATOMS) and not _by_identity(key):
        raise ValueError(f"a key of a dict or an element of a set of {type(key).__name__}")
    return left


_ATOMS: Final = (str, bytes, int, float, Enum, np.generic, types.NoneType)


def _by_identity(key: object) -> bool:
    """True if an object's hash does not depend on its content."""
    own: object = type(key).__hash__
    return own is object.__hash__
