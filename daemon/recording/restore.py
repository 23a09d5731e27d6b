"""Reads back what `daemon.recording.checkpoint` has taken: objects of the estimator and of the cycle, and nothing else.

A state file may come from anywhere: by mail, from a customer's robot. So not only what it names is limited, but also
what it does with it (see :class:`_Reader`): nothing is called but what makes data, and only fields are set, of what the
file itself has made. Classes, functions and members of enumerations are shared with the running program; they cannot
be changed.
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
"""Pieces that refer to nothing else."""
FIXED: Final = (Keyframe, Settled, Patch)
"""Pieces that refer to others; they never change once something refers to them."""
ROOT: Final = -1
"""Number of the piece with all that is small."""
ESTIMATOR: Final = "estimator."
"""Prefix of the estimator's modules."""
SYSTEM: Final = frozenset(
    (
        *("estimator.lazy_exports", "estimator.numerics.jit", "estimator.numerics.jit_cache"),
        "estimator.numerics.jit_cache_load",
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
"""Modules whose classes the cycle's memory consists of."""
KNOWN: Final = {
    "builtins": {"set", "frozenset", "complex", "bytearray", "dict", "list", "object", "range", "slice"},
    "collections": {"deque", "Counter", "OrderedDict", "defaultdict"},
    "functools": {"partial"},
    "array": {"array", "_array_reconstructor"},
    "numpy": {"ndarray", "dtype"},
    "numpy._core.multiarray": {"_reconstruct", "scalar"},
    "numpy._core.numeric": {"_frombuffer"},
}
"""What may be made besides classes of our own and functions of the estimator: nothing that reaches the system."""
_NOT_THERE: Final = object()
PLAIN: Final = "biufcSU"
"""Kinds of numpy arrays: no objects, no structures."""


_REFUSED: Final = (
    *(pickle.UnpicklingError, AttributeError, ImportError, LookupError, TypeError, ValueError, EOFError),
    *(ArithmeticError, MemoryError, RecursionError, struct.error),
)
"""What reading a damaged or forged state may raise; numbers too large or cut in half lead to the last four."""


class CannotRestore(Exception):
    """What was kept was made by other software, or is damaged."""


class Piece(NamedTuple):
    """One part of a checkpoint: its number, :data:`ROOT` for the last one; its class; its content, pickled."""

    number: int
    kind: str
    content: bytes


@lru_cache(maxsize=64)
def field_names(kind: type) -> tuple[str, ...]:
    """Names of a dataclass's fields; none of any other class."""
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


# what stands in a state by name: the writer refers to these, the reader calls them


def piece_of(number: int) -> object:
    """Stands for the reader's own in what is written."""
    raise AssertionError("pieces are looked up by their reader")


def weak_set(content: Sequence[Any]) -> WeakSet[Any]:
    """A set that does not keep its content alive."""
    return WeakSet(content)


def blank(kind: type) -> object:
    """An object of one of our classes whose fields are yet to be filled."""
    if not _ours(kind):
        raise pickle.UnpicklingError(f"{kind!r} does not belong into a state")
    return object.__new__(kind)


def fill(made: object, said: dict[str, Any]) -> None:
    """Set fields of an object of one of our classes: these and nothing else of it.

    Raises:
        UnpicklingError: it is something that others share, that is no field of it, or not all of its fields.
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
    """A function within another one, with what it holds."""
    if not _computes(module):
        raise CannotRestore(f"{module}.{qualname} does not belong into a state")
    space = import_module(module).__dict__
    outer = space.get(qualname.partition(".<locals>")[0].partition(".")[0])
    code = _code(outer, qualname, line)
    if code is None or len(code.co_freevars) != len(held):
        raise CannotRestore(f"{module} has no {qualname} in line {line}")
    return types.FunctionType(code, space, code.co_name, defaults, tuple(types.CellType(one) for one in held))


def _code(within: object, qualname: str, line: int) -> types.CodeType | None:
    """The code of a function somewhere within a function or a class."""
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
    """A plain dtype; the one that all share, so it is never filled (:meth:`_Reader.build`)."""
    found = np.dtype(str(text))
    if found.kind not in PLAIN or found.names is not None:
        raise pickle.UnpicklingError(f"arrays of {text!r} do not belong into a state")
    return found


def _ours(kind: object) -> bool:
    """Whether it is a class of the estimator or of what the cycle's memory consists of."""
    if not isinstance(kind, type):
        return False
    return kind.__module__ in PARTS or _computes(kind.__module__)


def _computes(module: str) -> bool:
    """Whether a module of the estimator does nothing but compute."""
    return module.startswith(ESTIMATOR) and module not in SYSTEM


@lru_cache(maxsize=1024)
def _is_field(kind: type, name: str) -> bool:
    """Whether objects of a class have a field of that name: neither a method nor anything else of the class."""
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
"""What pickle's writer makes of data at protocol 5; the rest of its commands (instances of old, extensions, persistent
names) has no place in a state."""


class _Reader(pickle._Unpickler):
    """Reads; looks pieces up, and makes nothing but data and what computes with them.

    It is pickle's reader in Python, whose commands can be replaced: it calls (REDUCE, NEWOBJ) nothing but classes and
    the few functions that make data, and it fills (BUILD) what has just been made, by :func:`fill`.
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
        """The class or function of that name, if it is one that a state consists of."""
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
        """REDUCE: call what makes data."""
        given = self.stack.pop()
        called = self.stack[-1]
        if not (_makes(called) or id(called) in self._makers):
            raise pickle.UnpicklingError(f"{called!r} is not called by a state")
        struct = isinstance(called, type) and issubclass(called, msgspec.Struct)
        if struct and len(given) != len(called.__struct_fields__):  # by position: those left out would be made up
            raise pickle.UnpicklingError(f"{called.__name__}: not all of its fields, or more")
        self.stack[-1] = called(*given)

    def newobj(self) -> None:
        """NEWOBJ: a new object of a class."""
        given, kind = self.stack.pop(), self.stack.pop()
        if not _makes(kind):
            raise pickle.UnpicklingError(f"{kind!r} makes nothing in a state")
        self.append(kind.__new__(kind, *given))

    def newobj_ex(self) -> None:
        """NEWOBJ_EX: the same with named arguments."""
        named, given, kind = self.stack.pop(), self.stack.pop(), self.stack.pop()
        if not _makes(kind):
            raise pickle.UnpicklingError(f"{kind!r} makes nothing in a state")
        self.append(kind.__new__(kind, *given, **named))

    def build(self) -> None:
        """BUILD: fill what has been made."""
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
    """Whether it is a class that makes data; numpy has functions of its own for its arrays."""
    return isinstance(kind, type) and kind is not np.ndarray


def _sized(made: np.dtype[Any], said: Any) -> bool:
    """Whether this is what numpy says of a text's dtype, whose size is part of it."""
    return made.kind in "SU" and said[1:5] == (made.str[0], None, None, None) and said[5] == made.itemsize


def _said_of(kind: type, said: Any) -> dict[str, Any]:
    """Fields by name, however pickle keeps them: as a list by a frozen dataclass, apart by a class with slots."""
    if isinstance(said, list):
        return dict(zip(field_names(kind), said, strict=True))
    if isinstance(said, tuple):
        attributes, slots = said
        return {**(attributes or {}), **(slots or {})}
    return dict(said)


def restore(pieces: Iterator[Piece]) -> tuple[State, dict[str, Any]]:
    """The state and the rest, as they were taken.

    Raises:
        CannotRestore: they were taken by other software, or are damaged.
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
