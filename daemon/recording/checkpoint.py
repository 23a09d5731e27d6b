"""Writer of checkpoints: captures the estimator state within a cycle, and describes it by the schema later.

A replay of a dump starts from such a checkpoint. The capture must not delay the cycle, however large the map is. It
therefore has two parts. Small values that change all the time are copied at once (:func:`capture`). Large objects never
change once they exist (keyframes, finished submaps, patches). The capture only refers to them. Submaps are few and do
change, so the values of their fields are copied at once. Another thread makes the nodes of the schema from all of
these, one after the other (:meth:`Taken.nodes`).

The copy is made by pickle, the fastest copier of Python, and stays in this process. `daemon.recording.state_schema` has
the format of the file, `daemon.recording.restore` reads it.
"""

from __future__ import annotations

import io
import pickle
import types
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import fields
from enum import Enum
from functools import partial
from operator import attrgetter
from typing import Any, Final
from weakref import WeakSet

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
    fields_of,
    is_enumeration,
    is_named_tuple,
    name_of,
)
from estimator import (
    Keyframe,
    MapState,
    MatchMemory,
    Patch,
    ResidualMap,
    SearchedAside,
    Settled,
    State,
    Submap,
    SubmapGraph,
    Survey,
)

PROTOCOL: Final = 5
_SCALARS: Final = frozenset((type(None), bool, float, str))
_LEAST, _MOST = -(1 << 63), 1 << 64
"""Range of the integers that a file holds."""


class CannotTake(Exception):
    """Part of the state cannot be stored; this is a defect, and the text names the part."""


class Taken:
    """A captured state: the small values copied, the large objects referenced."""

    def __init__(self) -> None:
        self._held: list[object] = []  # kept alive to the end: numbers are looked up by identity
        self._numbers: dict[int, int] = {}
        self._submaps: dict[int, tuple[Any, ...]] = {}  # fields of submaps at the time of the capture
        self._copy = b""

    def hold(self, one: object) -> int:
        """Returns the number of an object that is referenced; adds it at its first use."""
        number = self._numbers.get(id(one))
        if number is None:
            if isinstance(one, Submap):
                self.hold_all([one])
                return self._numbers[id(one)]
            number = self._numbers[id(one)] = len(self._held)
            self._held.append(one)
            if isinstance(one, Keyframe):  # capture the submaps that it refers to before they change
                self.hold(one.submap)
            elif isinstance(one, Settled):
                self.hold(one.witness.submap)
        return number

    def hold_all(self, submaps: Iterable[Submap]) -> None:
        """Adds submaps, and the submaps that they refer to, with their present field values."""
        numbers, held, values = self._numbers, self._held, self._submaps
        waiting = list(submaps)
        while waiting:
            submap = waiting.pop()
            if id(submap) in numbers:
                continue
            numbers[id(submap)] = len(held)
            held.append(submap)
            hung = tuple(submap.hung) if len(submap.hung) else ()
            values[id(submap)] = *_of_submap(submap), hung
            waiting += hung
            if submap.into is not None:
                waiting.append(submap.into[0])
            if submap.settled is not None:
                waiting.append(submap.settled.witness.submap)

    def seal(self, root: object) -> None:
        """Copies the small values; called once."""
        file = io.BytesIO()
        _Copier(file, self).dump(root)
        self._copy = file.getvalue()

    @property
    def copied_bytes(self) -> int:
        """Size of the small values that were copied."""
        return len(self._copy)

    def nodes(self) -> Iterator[Node]:
        """Yields every node; may run in another thread while the daemon continues.

        Raises:
            CannotTake: some part belongs into no state.
        """
        root = _Original(io.BytesIO(self._copy), self._held).load()
        return _Describer(self._submaps).nodes(root)


class _Weak(tuple[object, ...]):
    """Elements of a `WeakSet`, which keep their order."""


_SUBMAP: Final = (*(field.name for field in fields(Submap) if field.name != "hung"), "hung")
_of_submap: Final = attrgetter(*_SUBMAP[:-1])
_submap_of: Final = attrgetter("submap")


def capture(state: State, rest: dict[str, object]) -> Taken:
    """Captures the estimator state and the ``rest``, which may refer to the same objects.

    The duration grows with the number of submaps and keyframes; docs/performance.md has figures.

    Raises:
        CannotTake: some part cannot be copied.
    """
    taken = Taken()
    taken.hold_all(set(map(_submap_of, state.map.keyframes.values())).union(state.map.graph.submaps.values()))
    if (aside := state.map.parts.aside) is not None:
        taken.hold_all(set(map(_submap_of, aside.frames.values())).union(aside.submaps.values()))
    try:
        taken.seal({"state": state, "rest": rest})
    except (TypeError, AttributeError, ValueError, pickle.PicklingError, RecursionError) as error:
        raise CannotTake(f"the checkpoint cannot be made: {error}") from error
    return taken


# the copy within this process


def held(number: int) -> object:
    """Placeholder in the copy for an object that is referenced; never called."""
    raise AssertionError("referenced objects are looked up by number")


def blank(kind: type) -> object:
    """Returns an object with its fields not yet set."""
    return object.__new__(kind)


def fill(made: object, said: dict[str, Any]) -> None:
    """Sets the fields of an object."""
    for name, value in said.items():
        object.__setattr__(made, name, value)


class _Copier(pickle.Pickler):
    """Pickler that writes references in place of large objects."""

    def __init__(self, file: io.BytesIO, taken: Taken) -> None:
        super().__init__(file, PROTOCOL)
        self._taken = taken

    def reducer_override(self, obj: object) -> Any:
        """Returns the reduction of objects that pickle does not copy as they are."""
        reduced = _REDUCED.get(type(obj))
        return NotImplemented if reduced is None else reduced(obj, self._taken)


class _Original(pickle.Unpickler):
    """Unpickler of a copy made by this process, which looks the referenced objects up."""

    def __init__(self, file: io.BytesIO, objects: list[object]) -> None:
        super().__init__(file)
        self._look_up = objects.__getitem__

    def find_class(self, module: str, name: str) -> Any:
        """Returns the class or function of that name."""
        if name == held.__name__ and module == __name__:
            return self._look_up
        return super().find_class(module, name)


class _Held:
    """An object to be referenced where pickle would copy it, as it copies a dict."""

    def __init__(self, one: object) -> None:
        self.one = one


def _fields(one: object) -> dict[str, Any]:
    return {name: getattr(one, name) for name in fields_of(type(one)) or ()}


def _changed(one: object, **changes: object) -> Any:
    return blank, (type(one),), {**_fields(one), **changes}, None, None, fill


def _state(state: State, taken: Taken) -> Any:
    return _changed(state, journal=None)


def _map(map_: MapState, taken: Taken) -> Any:
    places = {place: tuple(keys) for place, keys in map_.places.items()}
    return _changed(map_, keyframes=_Held(map_.keyframes.copy()), places=_Held(places))


def _matching(matching: MatchMemory, taken: Taken) -> Any:
    bearing = matching.bearing_rad
    return _changed(matching, bearing_rad=None if bearing is None else _Held(bearing))


def _graph(graph: SubmapGraph, taken: Taken) -> Any:
    return _changed(graph, submaps=_Held(graph.submaps.copy()), ties=_Held(graph.ties.copy()))


def _aside(aside: SearchedAside, taken: Taken) -> Any:
    return _changed(aside, submaps=_Held(aside.submaps), frames=_Held(aside.frames))  # neither is ever changed


def _function(function: types.FunctionType, taken: Taken) -> Any:
    return _reference(function, taken) if "<" in function.__qualname__ else NotImplemented


def _reference(one: object, taken: Taken) -> Any:
    return held, (taken.hold(one),)


_REDUCED: Final[dict[type, Callable[[Any, Taken], Any]]] = {
    **dict.fromkeys((Submap, Survey, ResidualMap, Keyframe, Settled, Patch), _reference),
    State: _state,
    MapState: _map,
    MatchMemory: _matching,
    SubmapGraph: _graph,
    SearchedAside: _aside,
    WeakSet: lambda elements, taken: (_Weak, (tuple(elements),)),
    types.FunctionType: _function,
    _Held: lambda one, taken: (held, (taken.hold(one.one),)),
}


# the description by the schema


class _Describer:
    """Makes the nodes of a graph of objects; each object becomes one node."""

    def __init__(self, submaps: dict[int, tuple[Any, ...]]) -> None:
        self._submaps = submaps
        self._numbers: dict[int, int] = {}
        self._kinds: dict[tuple[type, tuple[str, ...]], int] = {}
        self._waiting: list[object] = []  # by number; an object is kept alive until all are described

    def nodes(self, root: object) -> Iterator[Node]:
        """Yields the nodes by number, the root first; raises `CannotTake`."""
        self._value(root)
        at = 0
        while at < len(self._waiting):
            try:
                yield self._node(self._waiting[at])
            except UnknownName as error:
                raise CannotTake(str(error)) from error
            at += 1

    def _value(self, one: Any) -> Value:
        kind = type(one)
        if kind in _SCALARS:
            return one  # type: ignore[no-any-return]  # of one of these types
        if kind is int:
            if not _LEAST <= one < _MOST:
                raise CannotTake(f"the number {one} is too large for a checkpoint")
            return one  # type: ignore[no-any-return]
        number = self._numbers.get(id(one))
        if number is None:
            number = self._numbers[id(one)] = len(self._waiting)
            self._waiting.append(one)
        return Ref(number)

    def _values(self, many: Iterable[object]) -> list[Value]:
        return list(map(self._value, many))

    def _node(self, one: Any) -> Node:
        kind = type(one)
        if kind is Kind:
            return one  # type: ignore[no-any-return]
        if kind is np.ndarray or isinstance(one, np.generic):
            return _array(one)
        if kind in CONTAINERS or kind is _Weak:
            longest = one.maxlen if kind is deque else None
            return Many("weakset" if kind is _Weak else CONTAINERS[kind], self._values(one), longest)
        if kind is bytes:
            return Blob(one)
        if kind is dict:
            return Table(self._values(one), self._values(one.values()))
        if isinstance(one, Enum):
            return Member(name_of(kind), one.value)
        if kind is types.FunctionType:
            return Call(name_of(one))
        if kind is partial:
            if one.keywords:
                raise CannotTake(f"{one}: a job has arguments by position only")
            return Call(name_of(one.func), self._values(one.args))
        return self._record(one, kind)

    def _record(self, one: Any, kind: type) -> Record:
        if isinstance(one, (dict, list, set, frozenset, deque, str, bytes, int, float, type)) or (
            isinstance(one, tuple) and not is_named_tuple(kind)
        ):
            raise CannotTake(f"{kind.__module__}.{kind.__qualname__} cannot be part of a checkpoint")
        names = fields_of(kind)
        if kind is Submap:
            said = self._of_submap(one)
        elif names is None:
            said = attributes(one)
            names = tuple(said)
        else:
            said = {name: getattr(one, name) for name in names}
        assert names is not None
        return Record(self._kind(kind, names), [self._value(said[name]) for name in names])

    def _of_submap(self, submap: Submap) -> dict[str, Any]:
        values = self._submaps.get(id(submap))
        if values is None:
            raise CannotTake(f"submap {submap.key} was missing when the checkpoint was made")
        return {**dict(zip(_SUBMAP, values, strict=True)), "hung": _Weak(values[-1])}

    def _kind(self, kind: type, names: tuple[str, ...]) -> int:
        number = self._kinds.get((kind, names))
        if number is None:
            if is_enumeration(kind):
                raise UnknownName(f"{kind} has no records")
            number = self._kinds[kind, names] = len(self._waiting)
            self._waiting.append(Kind(name_of(kind), names))
        return number


def attributes(one: object) -> dict[str, Any]:
    """Returns the attributes of an object whose class declares no fields; of an exception also its arguments."""
    slots = (name for kind in type(one).__mro__ for name in getattr(kind, "__slots__", ()))
    said = {name: getattr(one, name) for name in slots if hasattr(one, name)}
    if isinstance(one, BaseException):
        said["args"] = one.args
    return {**said, **getattr(one, "__dict__", {})}


def _array(one: Any) -> Array:
    dtype = one.dtype
    if dtype.kind not in PLAIN or dtype.names is not None:
        raise CannotTake(f"arrays of {dtype} cannot be part of a checkpoint")
    order = "F" if one.flags.f_contiguous and not one.flags.c_contiguous else "C"
    return Array(dtype.str, one.shape, order, one.tobytes(order), isinstance(one, np.generic))
