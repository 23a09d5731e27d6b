"""Reader of checkpoints: a restricted unpickler for objects of the estimator and the cycle, and for nothing else.

A checkpoint may come from anywhere, for example by mail from a customer's robot. The reader therefore limits what a
file names and also what it does (see :class:`_Reader`). It calls only what makes data. It sets only fields of objects
that the file itself has made. Classes, functions and enumeration members belong to the running program and cannot be
changed. `daemon.recording.checkpoint` writes the files.
"""

from __future__ import annotations

import inspect
import io
import pickle
import struct
import types
from collections.abc import Callable, Iterator, Sequence
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import lru_cache, partial
from importlib import import_module
from typing import Any, ClassVar, Final, NamedTuple
from weakref import WeakSet

import msgspec
import numpy as np

from estimator import Keyframe, Patch, ResidualMap, Settled, State, Submap, Survey

WHOLE: Final = (Survey, ResidualMap, np.ndarray)
"""Pieces that refer to no other piece."""
FIXED: Final = (Keyframe, Settled, Patch)
"""Pieces that refer to others; they never change once something refers to them."""
ROOT: Final = -1
"""Number of the piece with all small values."""
ESTIMATOR: Final = "estimator."
"""Prefix of the estimator's modules."""
SYSTEM: Final = frozenset(
    (
        *("estimator.lazy_exports", "estimator.numerics.jit", "estimator.numerics.jit_cache"),
        *("estimator.numerics.jit_cache_file", "estimator.numerics.jit_cache_load"),
    )
)
"""Modules of the estimator that import modules or read files: nothing of them belongs into a state."""
PARTS: Final = frozenset(
    (
        *("daemon.snapshot", "daemon.devices.conversion", "daemon.health.faults", "daemon.health.reasons"),
        *(f"daemon.integrity.{name}" for name in ("position_alert", "arrival_monitor", "observer", "lamp_monitor")),
        *(f"daemon.integrity.{name}" for name in ("laser_hysteresis", "state_machine", "evidence", "state_memory")),
        *("daemon.integrity.input_monitor", "daemon.integrity.motion_consistency"),
        *("daemon.runtime.inbox", "daemon.runtime.scan_period", "daemon.runtime.snapshot_builder"),
        *("hal.adc", "hal.errors", "hal.imu", "hal.lidar", "hal.odometry"),
    )
)
"""Modules whose classes the memory of the cycle consists of."""
KNOWN: Final = {
    "builtins": {"set", "frozenset", "complex", "bytearray", "dict", "list", "object", "range", "slice"},
    "collections": {"deque", "Counter", "OrderedDict", "defaultdict"},
    "functools": {"partial"},
    "array": {"array", "_array_reconstructor"},
    "numpy": {"ndarray", "dtype"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
}
"""Further names that a file may use, besides our classes and functions of the estimator; none reaches the system."""
_NOT_THERE: Final = object()
PLAIN: Final = "biufcSU"
"""Kinds of numpy arrays allowed: no objects, no structures."""


_REFUSED: Final = (
    *(pickle.UnpicklingError, AttributeError, ImportError, LookupError, TypeError, ValueError, EOFError),
    *(ArithmeticError, MemoryError, RecursionError, struct.error),
)
"""Exceptions that a damaged or forged state may raise. Numbers that are too large or truncated lead to the last
four."""


class CannotRestore(Exception):
    """The checkpoint was made by other software, or is damaged."""


class Piece(NamedTuple):
    """One part of a checkpoint: number (:data:`ROOT` for the last one), class, and pickled content."""

    number: int
    kind: str
    content: bytes


@lru_cache(maxsize=64)
def field_names(kind: type) -> tuple[str, ...]:
    """Returns the names of a dataclass's fields; empty for any other class."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


# functions that a checkpoint names: the writer refers to them, the reader calls them


def piece_of(number: int) -> object:
    """Placeholder in the file for the piece lookup of the reader; never called."""
    raise AssertionError("pieces are looked up by their reader")


def weak_set(content: Sequence[Any]) -> WeakSet[Any]:
    """Returns a set that does not keep its elements alive."""
    return WeakSet(content)


def blank(kind: type) -> object:
    """Returns an object of one of our classes, with its fields not yet set."""
    if not _ours(kind):
        raise pickle.UnpicklingError(f"{kind!r} does not belong into a state")
    return object.__new__(kind)


def fill(made: object, said: dict[str, Any]) -> None:
    """Sets the fields of an object of one of our classes, and nothing else of it.

    Raises:
        UnpicklingError: the object is shared, a name is not a field, or a field is missing.
    """
    kind: type = type(made)
    if isinstance(made, Enum) or not _ours(kind):
        raise pickle.UnpicklingError(f"{kind.__name__}: nothing of it may be set")
    for name, value in said.items():
        if not _is_field(kind, name):
            raise pickle.UnpicklingError(f"{kind.__name__} has no field {name!r}")
        object.__setattr__(made, name, value)
    for name in field_names(kind):
        if not hasattr(made, name):
            raise pickle.UnpicklingError(f"{kind.__name__} lacks {name!r}: other software has written it")


def function_within(
    module: str, qualname: str, line: int, held: tuple[object, ...], defaults: tuple[object, ...] | None
) -> types.FunctionType:
    """Returns a nested function of the estimator with its closure and defaults.

    Raises:
        CannotRestore: the module has no such function at that line.
    """
    if not _computes(module):
        raise CannotRestore(f"{module}.{qualname} does not belong into a state")
    space = import_module(module).__dict__
    outer = space.get(qualname.partition(".<locals>")[0].partition(".")[0])
    code = _code(outer, qualname, line)
    if code is None or len(code.co_freevars) != len(held):
        raise CannotRestore(f"{module} has no {qualname} in line {line}")
    return types.FunctionType(code, space, code.co_name, defaults, tuple(types.CellType(one) for one in held))


def _code(within: object, qualname: str, line: int) -> types.CodeType | None:
    """Returns the code object of a nested function of a function or class; None if there is none."""
    if isinstance(within, type):
        inside: Sequence[object] = tuple(vars(within).values())
    elif isinstance(within, types.FunctionType):
        inside = (within.__code__,)
    elif isinstance(within, types.CodeType):
        if (within.co_qualname, within.co_firstlineno) == (qualname, line):
            return within
        inside = tuple(one for one in within.co_consts if isinstance(one, types.CodeType))
    else:
        return None
    return next((code for one in inside if (code := _code(one, qualname, line)) is not None), None)


def _dtype(text: str, *_: object) -> np.dtype[Any]:
    """Returns a plain dtype. It is shared by all arrays, so :meth:`_Reader.build` never fills it."""
    found = np.dtype(str(text))
    if found.kind not in PLAIN or found.names is not None:
        raise pickle.UnpicklingError(f"arrays of {text!r} do not belong into a state")
    return found


def _ours(kind: object) -> bool:
    """True for a class of the estimator or of the modules in :data:`PARTS`."""
    if not isinstance(kind, type):
        return False
    return kind.__module__ in PARTS or _computes(kind.__module__)


def _computes(module: str) -> bool:
    """Whether a module of the estimator does nothing but compute."""
    return module.startswith(ESTIMATOR) and module not in SYSTEM


@lru_cache(maxsize=1024)
def _is_field(kind: type, name: str) -> bool:
    """True if objects of a class have a field of that name; methods and other class attributes do not count."""
    if is_dataclass(kind):
        return name in field_names(kind)
    if not name.isidentifier() or name.startswith("__"):
        return False
    there = inspect.getattr_static(kind, name, _NOT_THERE)
    return there is _NOT_THERE or isinstance(there, types.MemberDescriptorType)


HERE: Final = {one.__name__: one for one in (weak_set, blank, fill, function_within)}
_CALLED: Final = frozenset(
    f"{module}.{name}" for module, names in KNOWN.items() for name in names if name.startswith("_") or name == "scalar"
)
_DATA: Final = frozenset(
    (
        *(pickle.PROTO, pickle.FRAME, pickle.STOP, pickle.MARK, pickle.POP, pickle.POP_MARK, pickle.NONE),
        *(pickle.NEWTRUE, pickle.NEWFALSE, pickle.BININT, pickle.BININT1, pickle.BININT2, pickle.LONG1, pickle.LONG4),
        *(pickle.BINFLOAT, pickle.SHORT_BINUNICODE, pickle.BINUNICODE, pickle.BINUNICODE8, pickle.SHORT_BINBYTES),
        *(pickle.BINBYTES, pickle.BINBYTES8, pickle.BYTEARRAY8, pickle.EMPTY_TUPLE, pickle.TUPLE1, pickle.TUPLE2),
        *(pickle.TUPLE3, pickle.TUPLE, pickle.EMPTY_LIST, pickle.APPEND, pickle.APPENDS, pickle.EMPTY_DICT),
        *(pickle.SETITEM, pickle.SETITEMS, pickle.EMPTY_SET, pickle.ADDITEMS, pickle.FROZENSET, pickle.MEMOIZE),
        *(pickle.BINGET, pickle.LONG_BINGET, pickle.BINPUT, pickle.LONG_BINPUT, pickle.STACK_GLOBAL),
    )
)
"""Opcodes that pickle writes for data at protocol 5. Its other opcodes (old instances, extensions, persistent names)
are refused in a checkpoint."""


class _Reader(pickle._Unpickler):
    """Restricted unpickler: looks pieces up, and makes only data and the functions that compute with them.

    It derives from pickle's reader in Python, whose opcodes can be replaced. REDUCE and NEWOBJ call only classes and
    the few functions that make data. BUILD fills only an object that the file has just made, by :func:`fill`.
    """

    stack: list[Any]
    append: Callable[[Any], None]
    dispatch: ClassVar[dict[int, Callable[[Any], None]]] = {
        code: act for code, act in pickle._Unpickler.dispatch.items() if bytes([code]) in _DATA
    }

    def __init__(self, content: bytes, pieces: Callable[[int], object]) -> None:
        super().__init__(io.BytesIO(content), fix_imports=False)
        self._piece = pieces
        self._makers: set[int] = {id(pieces), id(_dtype), *map(id, HERE.values())}

    def find_class(self, module: str, name: str) -> Any:
        """Returns the class or function of that name.

        Raises UnpicklingError for a name that a checkpoint may not use.
        """
        if module == __name__:
            return self._piece if name == piece_of.__name__ else HERE[name]
        if name in KNOWN.get(module, ()):
            found = _dtype if (module, name) == ("numpy", "dtype") else super().find_class(module, name)
            if f"{module}.{name}" in _CALLED:
                self._makers.add(id(found))
            return found
        if (module in PARTS or _computes(module)) and "." not in name:
            found = super().find_class(module, name)
            function = isinstance(found, types.FunctionType) and _computes(module)
            if (function or _ours(found)) and found.__module__ == module:
                return found
        raise pickle.UnpicklingError(f"{module}.{name} does not belong into a state")

    def reduce(self) -> None:
        """REDUCE: calls a class or function that makes data."""
        given = self.stack.pop()
        called = self.stack[-1]
        if not (_makes(called) or id(called) in self._makers):
            raise pickle.UnpicklingError(f"{called!r} is not called by a state")
        struct = isinstance(called, type) and issubclass(called, msgspec.Struct)
        if struct and len(given) != len(called.__struct_fields__):  # by position: missing ones would get default values
            raise pickle.UnpicklingError(f"{called.__name__}: not all of its fields, or more")
        self.stack[-1] = called(*given)

    def newobj(self) -> None:
        """NEWOBJ: makes a new object of a class."""
        given, kind = self.stack.pop(), self.stack.pop()
        if not _makes(kind):
            raise pickle.UnpicklingError(f"{kind!r} makes nothing in a state")
        self.append(kind.__new__(kind, *given))

    def newobj_ex(self) -> None:
        """NEWOBJ_EX: makes a new object of a class with named arguments."""
        named, given, kind = self.stack.pop(), self.stack.pop(), self.stack.pop()
        if not _makes(kind):
            raise pickle.UnpicklingError(f"{kind!r} makes nothing in a state")
        self.append(kind.__new__(kind, *given, **named))

    def build(self) -> None:
        """BUILD: fills the object that was just made."""
        said = self.stack.pop()
        made = self.stack[-1]
        if isinstance(made, np.dtype):
            if said != (3, made.str[0], None, None, None, -1, -1, 0) and not _sized(made, said):
                raise pickle.UnpicklingError(f"arrays of {said!r} do not belong into a state")
        elif type(made) is np.ndarray or (type(made) is partial and said[3] is None):
            self.stack[-1].__setstate__(said)
        else:
            fill(made, _said_of(type(made), said))

    dispatch.update({pickle.REDUCE[0]: reduce, pickle.NEWOBJ[0]: newobj, pickle.NEWOBJ_EX[0]: newobj_ex})
    dispatch.update({pickle.BUILD[0]: build})


def _makes(kind: object) -> bool:
    """True for a class that makes data; numpy makes its arrays by functions of its own."""
    return isinstance(kind, type) and kind is not np.ndarray


def _sized(made: np.dtype[Any], said: Any) -> bool:
    """True for numpy's state of a text dtype, whose size is part of the state."""
    return made.kind in "SU" and said[1:5] == (made.str[0], None, None, None) and said[5] == made.itemsize


def _said_of(kind: type, said: Any) -> dict[str, Any]:
    """Returns the fields by name. Pickle stores a frozen dataclass as a list, and a class with slots as a pair."""
    if isinstance(said, list):
        return dict(zip(field_names(kind), said, strict=True))
    if isinstance(said, tuple):
        attributes, slots = said
        return {**(attributes or {}), **(slots or {})}
    return dict(said)


def restore(pieces: Iterator[Piece]) -> tuple[State, dict[str, Any]]:
    """Returns the state and the rest, as they were captured.

    Raises:
        CannotRestore: other software captured them, or they are damaged.
    """
    try:
        return _restored(pieces)
    except _REFUSED as error:
        raise CannotRestore(f"made by another version, or damaged: {error}") from error


def _restored(pieces: Iterator[Piece]) -> tuple[State, dict[str, Any]]:
    made: dict[int, object] = {}
    said: list[tuple[object, bytes]] = []
    root = b""
    whole = {f"{kind.__module__}:{kind.__qualname__}" for kind in WHOLE}
    empty = {f"{kind.__module__}:{kind.__qualname__}": kind for kind in (Submap, dict, *FIXED)}
    look_up = made.__getitem__
    for piece in pieces:
        if piece.number == ROOT:
            root = piece.content
        elif piece.kind in whole:
            made[piece.number] = _Reader(piece.content, look_up).load()
        else:
            kind = empty[piece.kind]
            made[piece.number] = {} if kind is dict else blank(kind)
            said.append((made[piece.number], piece.content))
    for one, content in said:
        _take_in(one, _Reader(content, look_up).load())
    everything = _Reader(root, look_up).load()
    state, rest = everything["state"], everything["rest"]
    if type(state) is not State or type(rest) is not dict:
        raise pickle.UnpicklingError("it holds no state")
    for place, keys in state.map.places.items():
        state.map.places[place] = list(keys)
    return state, rest


def _take_in(made: object, said: dict[str, Any]) -> None:
    if isinstance(made, dict):
        made.update(said)
    else:
        if isinstance(made, Submap):
            said = {**said, "hung": WeakSet(said["hung"])}
        fill(made, said)
