"""The state of a running daemon, taken within a cycle and written out later: where the replay of a dump begins.

Taking it must not delay the cycle, however large the map. So it is two things. What is small and changes all the time
is pickled at once (:func:`take`). What is large never changes once it is there (keyframes, settled submaps, patches):
it is only referred to, and pickled afterwards by another thread, piece by piece (:meth:`Taken.pieces`). Submaps are
few and do change, so the values of their fields are taken at once.

Jobs under way are functions within functions with what they hold. They are kept by name (:func:`_function`), and made
again from the same place of the same software.

What is read back (:func:`restore`) makes objects of the estimator and of the cycle, and nothing else: see `_Reader`.
"""

from __future__ import annotations

import io
import pickle
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, is_dataclass
from functools import lru_cache
from importlib import import_module
from operator import attrgetter
from typing import Any, Final, NamedTuple
from weakref import WeakSet

import numpy as np

from estimator.atlas import Atlas
from estimator.keyframe import Keyframe, Submap
from estimator.lamps import Survey
from estimator.patch import Patch
from estimator.residual import ResidualMap
from estimator.state import State
from estimator.submap import Settled

PROTOCOL: Final = 5
WHOLE: Final = (Survey, ResidualMap, np.ndarray)
"""Pieces that refer to nothing else."""
FIXED: Final = (Keyframe, Settled, Patch)
"""Pieces that refer to others; they never change once something refers to them."""
ESTIMATOR: Final = "estimator."
"""Numbers only: nothing in there knows the operating system."""
ROOT: Final = -1
"""Number of the piece with all that is small."""


class CannotTake(Exception):
    """Something in the state cannot be kept: a defect, which the text names."""


class CannotRestore(Exception):
    """What was kept was made by other software, or is damaged."""


class Piece(NamedTuple):
    """One part of a checkpoint: its number, :data:`ROOT` for the last one; its class; its content, pickled."""

    number: int
    kind: str
    content: bytes


@dataclass(frozen=True, slots=True)
class _Ref:
    """Stands for a piece."""

    number: int


class Taken:
    """What :func:`take` has taken."""

    def __init__(self) -> None:
        self._pieces: list[object] = []  # all stay alive to the end: their numbers go by their identities
        self._numbers: dict[int, int] = {}
        self._said: dict[int, tuple[Any, ...]] = {}  # fields of submaps as they were
        self._root = b""
        self._late = False

    def hold(self, piece: object) -> _Ref:
        """Refer to a piece."""
        number = self._numbers.get(id(piece))
        if number is None:
            if isinstance(piece, Submap):
                self.hold_all([piece])
                return self.hold(piece)
            number = self._numbers[id(piece)] = len(self._pieces)
            self._pieces.append(piece)
            if not self._late:  # the submaps that it refers to, while they are as they are
                if isinstance(piece, Keyframe):
                    self.hold(piece.submap)
                elif isinstance(piece, Settled):
                    self.hold(piece.witness.submap)
        return _Ref(number)

    def hold_all(self, submaps: Iterable[Submap]) -> None:
        """Refer to submaps, and to those that they refer to, as they are now."""
        numbers, pieces, said = self._numbers, self._pieces, self._said
        waiting = list(submaps)
        while waiting:
            submap = waiting.pop()
            if id(submap) in numbers:
                continue
            if self._late:
                raise CannotTake(f"submap {submap.key} was not there when the state was taken")
            number = numbers[id(submap)] = len(pieces)
            pieces.append(submap)
            hung = tuple(submap.hung) if len(submap.hung) else ()
            said[number] = *_of_submap(submap), hung
            waiting += hung
            if submap.into is not None:
                waiting.append(submap.into[0])
            if submap.settled is not None:
                waiting.append(submap.settled.witness.submap)

    def seal(self, root: object) -> None:
        """Pickle what is small; called once."""
        self._root = _pickled(root, self)
        self._late = True

    def pieces(self) -> Iterator[Piece]:
        """Everything, pickled a piece at a time; may run in another thread while the daemon goes on."""
        number = 0
        while number < len(self._pieces):  # pieces refer to more pieces
            piece = self._pieces[number]
            kind = type(piece)
            yield Piece(number, f"{kind.__module__}:{kind.__qualname__}", self._content(piece, number))
            number += 1
        yield Piece(ROOT, "", self._root)

    def _content(self, piece: object, number: int) -> bytes:
        if isinstance(piece, WHOLE):
            return pickle.dumps(piece, PROTOCOL)
        if isinstance(piece, dict):
            return _pickled(_Dict(piece), self)
        if isinstance(piece, Submap):
            return _pickled(dict(zip(_SUBMAP, self._said[number], strict=True)), self)
        return _pickled(_fields_of(piece), self)


_SUBMAP: Final = (*(field.name for field in fields(Submap) if field.name != "hung"), "hung")
_of_submap: Final = attrgetter(*_SUBMAP[:-1])


_submap_of: Final = attrgetter("submap")


class _Dict(NamedTuple):
    """A dict that is a piece of its own, so that pickling does not take it for a reference to itself."""

    content: dict[Any, Any]


@lru_cache(maxsize=64)
def _names(kind: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(kind)) if is_dataclass(kind) else ()


def _fields_of(piece: object) -> dict[str, Any]:
    kind: type = type(piece)
    return {name: getattr(piece, name) for name in _names(kind)}


def take(state: State, rest: dict[str, object]) -> Taken:
    """Take the estimator's state and the ``rest``, which may refer to the same things.

    Some hundred microseconds, and half a millisecond for a thousand submaps.

    Raises:
        CannotTake: something in them cannot be pickled.
    """
    taken = Taken()
    taken.hold_all(set(map(_submap_of, state.keyframes.values())).union(state.atlas.submaps.values()))
    try:
        taken.seal({"state": state, "rest": rest})
    except (TypeError, AttributeError, ValueError, pickle.PicklingError, RecursionError) as error:
        raise CannotTake(f"the state cannot be taken: {error}") from error
    return taken


class _Writer(pickle.Pickler):
    """Pickles; pieces become references."""

    def __init__(self, file: io.BytesIO, taken: Taken) -> None:
        super().__init__(file, PROTOCOL)
        self._taken = taken

    def reducer_override(self, obj: object) -> Any:
        """How the kinds of objects are kept that pickle does not know how to keep."""
        kept = _KEPT.get(type(obj))
        return NotImplemented if kept is None else kept(obj, self._taken)


def _pickled(what: object, taken: Taken) -> bytes:
    file = io.BytesIO()
    _Writer(file, taken).dump(what)
    return file.getvalue()


def _keep_state(state: State, taken: Taken) -> Any:
    said = _fields_of(state)
    said["keyframes"] = taken.hold(state.keyframes.copy())
    said["places"] = taken.hold({place: tuple(keys) for place, keys in state.places.items()})
    said["journal"] = None
    if state.bearing_rad is not None:
        said["bearing_rad"] = taken.hold(state.bearing_rad)
    return _blank, (State,), said, None, None, _fill


def _keep_atlas(atlas: Atlas, taken: Taken) -> Any:
    said = _fields_of(atlas)
    said["ties"] = taken.hold(atlas.ties.copy())
    return _blank, (Atlas,), said, None, None, _fill


def _keep_function(function: types.FunctionType, taken: Taken) -> Any:
    if "<" not in function.__qualname__:
        return NotImplemented
    held = tuple(cell.cell_contents for cell in function.__closure__ or ())
    names = function.__module__, function.__qualname__, function.__code__.co_firstlineno
    return _function, (*names, held, function.__defaults__)


def _keep_piece(piece: object, taken: Taken) -> Any:
    return _piece, (taken.hold(piece).number,)


_KEPT: Final[dict[type, Callable[[Any, Taken], Any]]] = {
    **dict.fromkeys((Submap, Survey, ResidualMap, *FIXED), _keep_piece),
    State: _keep_state,
    Atlas: _keep_atlas,
    types.FunctionType: _keep_function,
    WeakSet: lambda held, taken: (_weak, (tuple(held),)),
    _Ref: lambda ref, taken: (_piece, (ref.number,)),
    _Dict: lambda one, taken: (dict, (), None, None, iter(one.content.items())),
}


def _piece(number: int) -> object:
    """Stands for the reader's own in what is written."""
    raise AssertionError("pieces are looked up by their reader")


def _weak(content: Sequence[Any]) -> WeakSet[Any]:
    return WeakSet(content)


def _blank(kind: type) -> object:
    return object.__new__(kind)


def _fill(made: object, said: dict[str, Any]) -> None:
    for name, value in said.items():
        object.__setattr__(made, name, value)


def _function(
    module: str, qualname: str, line: int, held: tuple[object, ...], defaults: tuple[object, ...] | None
) -> types.FunctionType:
    """A function within another one, with what it holds."""
    if not module.startswith(ESTIMATOR):
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


PARTS: Final = frozenset(
    (
        *(
            f"daemon.{name}"
            for name in ("alarm", "bridge", "evidence", "health", "inbox", "lampwatch", "pace", "picture")
        ),
        *(f"daemon.{name}" for name in ("publish.snapshot", "reasons", "state", "state_evidence", "state_memory")),
        *("daemon.watch", "daemon.witness", "hal.adc", "hal.errors", "hal.imu", "hal.lidar", "hal.odometry"),
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
    "copyreg": {"_reconstructor", "__newobj__", "__newobj_ex__"},
}
"""What may be made besides classes of our own and functions of the estimator: nothing that reaches the system. It is no
protection of these classes themselves, whose attributes a forged state can set."""
HERE: Final = {one.__name__: one for one in (_weak, _blank, _fill, _function)}


_MADE: Final = (type, types.FunctionType)


class _Reader(pickle.Unpickler):
    """Reads; looks pieces up, and makes nothing but data and what computes with them."""

    def __init__(self, content: bytes, pieces: Callable[[int], object]) -> None:
        super().__init__(io.BytesIO(content))
        self._piece = pieces

    def find_class(self, module: str, name: str) -> Any:
        """The class or function of that name, if it is one that a state consists of."""
        if module == __name__:
            return self._piece if name == "_piece" else HERE[name]
        if name in KNOWN.get(module, ()):
            return super().find_class(module, name)
        if (module in PARTS or module.startswith(ESTIMATOR)) and "." not in name:
            found = super().find_class(module, name)
            if getattr(found, "__module__", "") == module and isinstance(
                found, _MADE if module.startswith(ESTIMATOR) else type
            ):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} does not belong into a state")


def restore(pieces: Iterator[Piece]) -> tuple[State, dict[str, Any]]:
    """The state and the rest, as they were taken.

    Raises:
        CannotRestore: they were taken by other software, or are damaged.
    """
    try:
        return _restored(pieces)
    except (pickle.UnpicklingError, AttributeError, ImportError, LookupError, TypeError, ValueError, EOFError) as error:
        raise CannotRestore(f"made by another version, or damaged: {error}") from error


def _restored(pieces: Iterator[Piece]) -> tuple[State, dict[str, Any]]:
    made: dict[int, object] = {}
    said: list[tuple[object, bytes]] = []
    root = b""
    whole = {f"{kind.__module__}:{kind.__qualname__}" for kind in WHOLE}
    blank = {f"{kind.__module__}:{kind.__qualname__}": kind for kind in (Submap, dict, *FIXED)}
    for piece in pieces:
        if piece.number == ROOT:
            root = piece.content
        elif piece.kind in whole:
            made[piece.number] = _Reader(piece.content, made.__getitem__).load()
        else:
            kind = blank[piece.kind]
            made[piece.number] = {} if kind is dict else _blank(kind)
            said.append((made[piece.number], piece.content))
    for one, content in said:
        _take_in(one, _Reader(content, made.__getitem__).load())
    everything = _Reader(root, made.__getitem__).load()
    state: State = everything["state"]
    for place, keys in state.places.items():
        state.places[place] = list(keys)
    return state, everything["rest"]


def _take_in(made: object, said: dict[str, Any]) -> None:
    if isinstance(made, dict):
        made.update(said)
    else:
        if isinstance(made, Submap):
            said = {**said, "hung": WeakSet(said["hung"])}
        _fill(made, said)


__all__ = ["CannotRestore", "CannotTake", "Piece", "Taken", "restore", "take"]
