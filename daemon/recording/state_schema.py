"""Schema of a stored state: the records of its file, and the names of the classes and functions in it.

A state is a table of nodes. Node 0 is the root. A value in a node is a scalar, or refers to another node by its number,
so that shared and cyclic references stay as they are, and nothing is nested. The classes are the dataclasses of the
estimator and of the cycle themselves: a :class:`Kind` has the name and the field names of one, and the reader compares
them with its own.

Names consist of a group and a class or function: ``mapping.Keyframe``. A group is a package of the estimator, or a list
of modules. Files of a package can be split and renamed without a change of names.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache
from importlib import import_module
from pkgutil import walk_packages
from types import FunctionType
from typing import Annotated, Any, Final, cast
from weakref import WeakSet

import msgspec

VERSION: Final = 3
"""Version of the schema. It rises when a node, or the name of a class or a field, changes its meaning."""
PACKAGES: Final = ("numerics", "cdma", "light_filter", "scan_matching", "fusion", "mapping", "relocalisation")
"""Packages of the estimator whose classes and functions a state contains."""
MODULES: Final = {
    "estimator": tuple(f"estimator.{name}" for name in ("job_queue", "measurements", "result", "state")),
    "cycle": (
        *("daemon.snapshot", "daemon.devices.conversion", "daemon.health.faults", "daemon.health.reasons"),
        *(
            f"daemon.integrity.{name}"
            for name in ("position_alert", "arrival_monitor", "observer", "lamp_monitor", "light_disturbance")
        ),
        *(f"daemon.integrity.{name}" for name in ("laser_hysteresis", "state_machine", "evidence", "state_memory")),
        *("daemon.integrity.input_monitor", "daemon.integrity.motion_consistency"),
        *("daemon.runtime.inbox", "daemon.runtime.scan_period", "daemon.runtime.snapshot_builder"),
    ),
    "hal": tuple(f"hal.{name}" for name in ("adc", "errors", "imu", "lidar", "odometry")),
}
"""Groups that are no package, with their modules."""
APART: Final = frozenset(
    f"estimator.{name}"
    for name in (
        "mapping.floorplan_import",
        *("numerics.jit", "numerics.jit_cache", "numerics.jit_cache_file", "numerics.jit_cache_load"),
    )
)
"""Modules of the packages that a state does not concern: they compile kernels that no run needs, or read files."""
MATCHER: Final = "scan_matching.match"
"""The only function in a state that belongs to no job."""
CONTAINERS: Final[dict[type, str]] = {
    list: "list",
    tuple: "tuple",
    set: "set",
    frozenset: "frozenset",
    deque: "deque",
    WeakSet: "weakset",
}
MOST_AXES: Final = 64
"""Limit of the dimensions of a numpy array (numpy 2)."""
PLAIN: Final = "biufcSU"
"""Kinds of numpy arrays allowed: no objects, no structures."""


class UnknownName(Exception):
    """A class or function that belongs into no state."""


class Ref(msgspec.Struct, array_like=True, frozen=True):
    """Reference to a node by its number."""

    node: int


Value = None | bool | int | float | str | Ref


class Kind(msgspec.Struct, array_like=True, tag="kind", frozen=True):
    """A class, and the names of the fields that its records have."""

    name: str
    fields: tuple[str, ...]


class Record(msgspec.Struct, array_like=True, tag="record", frozen=True):
    """An object of a class; ``kind``: number of the node of its class."""

    kind: int
    values: list[Value]


class Array(msgspec.Struct, array_like=True, tag="array", frozen=True):
    """A numpy array, or with ``scalar`` a number of its type; ``order``: ``C`` or ``F``."""

    dtype: str
    shape: Annotated[tuple[int, ...], msgspec.Meta(max_length=MOST_AXES)]
    order: str
    data: bytes
    scalar: bool = False


class Blob(msgspec.Struct, array_like=True, tag="bytes", frozen=True):
    """Bytes."""

    data: bytes


class Many(msgspec.Struct, array_like=True, tag="many", frozen=True):
    """A container of one of the :data:`CONTAINERS`; ``longest``: of a deque."""

    form: str
    items: list[Value]
    longest: int | None = None


class Table(msgspec.Struct, array_like=True, tag="table", frozen=True):
    """A dict."""

    keys: list[Value]
    values: list[Value]


class Member(msgspec.Struct, array_like=True, tag="member", frozen=True):
    """A member of an enumeration."""

    name: str
    value: int | str


class Call(msgspec.Struct, array_like=True, tag="call", frozen=True):
    """A function, or a partial call of it with arguments: the description of a job."""

    name: str
    given: list[Value] | None = None


class End(msgspec.Struct, array_like=True, tag="end", frozen=True):
    """The last entry of a file; ``nodes``: their number."""

    nodes: int


Node = Kind | Record | Array | Blob | Many | Table | Member | Call


def count_of(node: Node) -> int:
    """Number of values within a node, each of which takes memory however few bytes it has in the file."""
    match node:
        case Kind():
            return len(node.fields)
        case Record():
            return len(node.values)
        case Array():
            return len(node.shape)
        case Many():
            return len(node.items)
        case Table():
            return len(node.keys) + len(node.values)
        case Call():
            return len(node.given or ())
    return 0


def name_of(what: type | FunctionType) -> str:
    """Returns the name of a class or function in a state.

    Raises:
        UnknownName: it belongs into no state.
    """
    group = _group(what.__module__)
    name = f"{group}.{what.__qualname__}"
    if group is None or "." in what.__qualname__ or (isinstance(what, FunctionType) and not _is_stored(what)):
        raise UnknownName(f"{what.__module__}.{what.__qualname__} cannot be part of a checkpoint")
    return name


def class_of(name: str) -> type:
    """Returns the class of a name; raises `UnknownName`."""
    found = _member(name)
    if not isinstance(found, type):
        raise UnknownName(f"{name!r} is not a class of the checkpoint")
    return found


def function_of(name: str) -> Callable[..., Any]:
    """Returns the function of a name: one that jobs consist of, or the scan matcher; raises `UnknownName`."""
    found = _member(name)
    if not isinstance(found, FunctionType) or not _is_stored(found):
        raise UnknownName(f"{name!r} is not a function of the checkpoint")
    return found


def fields_of(kind: type) -> tuple[str, ...] | None:
    """Returns the names of the fields of a class; None if each object may have other ones."""
    if is_dataclass(kind):
        return _dataclass_fields(kind)
    if issubclass(kind, msgspec.Struct):
        return kind.__struct_fields__
    return cast(Any, kind)._fields if is_named_tuple(kind) else None


@lru_cache(maxsize=1024)
def _dataclass_fields(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind))


def is_named_tuple(kind: Any) -> bool:
    """True for a class made by `typing.NamedTuple`."""
    return isinstance(kind, type) and issubclass(kind, tuple) and hasattr(kind, "_fields")


def is_enumeration(kind: type) -> bool:
    """True for a class whose objects are members, not records."""
    return issubclass(kind, Enum)


@lru_cache(maxsize=256)
def _group(module: str) -> str | None:
    room, _, rest = module.partition(".")
    package, _, file = rest.partition(".")
    if room == "estimator" and package in PACKAGES and file:
        return None if module in APART else package
    return next((group for group, modules in MODULES.items() if module in modules), None)


def _is_stored(function: FunctionType) -> bool:
    from estimator import JOB_FUNCTIONS, scan_matcher

    return function in JOB_FUNCTIONS or function is scan_matcher.match


def _member(name: str) -> object:
    group, _, own = name.partition(".")
    if group not in MODULES and group not in PACKAGES:
        raise UnknownName(f"{name!r} cannot be part of a checkpoint")
    return members(group).get(own)


@lru_cache(maxsize=32)
def members(group: str) -> dict[str, object]:
    """Returns the classes and functions of a group by their own names, and loads its modules.

    Raises:
        UnknownName: two of its classes have one name; this is a defect.
    """
    found: dict[str, object] = {}
    for module in map(import_module, _modules(group)):
        for name, one in vars(module).items():
            if getattr(one, "__module__", "") != module.__name__ or not isinstance(one, type | FunctionType):
                continue
            if isinstance(one, FunctionType) and not _is_stored(one):
                continue
            if name in found:
                raise UnknownName(f"{group}: two modules define {name}")
            found[name] = one
    return found


def _modules(group: str) -> Iterator[str]:
    if group in MODULES:
        yield from MODULES[group]
        return
    package = import_module(f"estimator.{group}")
    for found in walk_packages(package.__path__, f"{package.__name__}."):
        if found.name not in APART:
            yield found.name
