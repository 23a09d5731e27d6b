"""Writer of checkpoints: captures the estimator state within a cycle and pickles it later.

A replay of a dump starts from such a checkpoint. The capture must not delay the cycle, however large the map is. It
therefore has two parts. Small values that change all the time are pickled at once (:func:`capture`). Large objects
never change once they exist (keyframes, finished submaps, patches). The capture only refers to them, and another
thread pickles them later, one piece at a time (:meth:`Taken.pieces`). Submaps are few and do change, so the values of
their fields are copied at once.

Pending jobs are nested functions with the variables that they capture. They are stored by name
(:func:`daemon.recording.restore.function_within`) and rebuilt from the same source line of the same software version.
`daemon.recording.restore` reads what this module writes.
"""

from __future__ import annotations

import io
import pickle
import types
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields
from enum import Enum
from operator import attrgetter
from typing import Any, Final, NamedTuple
from weakref import WeakSet

from daemon.recording.restore import (
    FIXED,
    ROOT,
    WHOLE,
    Piece,
    blank,
    field_names,
    fill,
    function_within,
    piece_of,
    weak_set,
)
from estimator import (
    Keyframe,
    MapState,
    MatchMemory,
    ResidualMap,
    SearchedAside,
    Settled,
    State,
    Submap,
    SubmapGraph,
    Survey,
)

PROTOCOL: Final = 5


class CannotTake(Exception):
    """Part of the state cannot be stored; this is a defect, and the text names the part."""


@dataclass(frozen=True, slots=True)
class _Ref:
    """Reference to a piece by its number."""

    number: int


class Taken:
    """A captured state: the small values pickled, the large pieces referenced."""

    def __init__(self) -> None:
        self._pieces: list[object] = []  # kept alive to the end: numbers are looked up by identity
        self._numbers: dict[int, int] = {}
        self._said: dict[int, tuple[Any, ...]] = {}  # fields of submaps at the time of the capture
        self._root = b""
        self._late = False

    def hold(self, piece: object) -> _Ref:
        """Returns the reference to a piece; adds the piece at its first use."""
        number = self._numbers.get(id(piece))
        if number is None:
            if isinstance(piece, Submap):
                self.hold_all([piece])
                return self.hold(piece)
            number = self._numbers[id(piece)] = len(self._pieces)
            self._pieces.append(piece)
            if not self._late:  # capture the submaps that it refers to before they change
                if isinstance(piece, Keyframe):
                    self.hold(piece.submap)
                elif isinstance(piece, Settled):
                    self.hold(piece.witness.submap)
        return _Ref(number)

    def hold_all(self, submaps: Iterable[Submap]) -> None:
        """Adds submaps, and the submaps that they refer to, with their present field values."""
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
        """Pickles the small values; called once."""
        self._root = _pickled(root, self)
        self._late = True

    def pieces(self) -> Iterator[Piece]:
        """Yields every piece in pickled form, the root last; may run in another thread while the daemon continues."""
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
    """A dict that is a piece of its own; the wrapper keeps the pickler from replacing it by a reference to itself."""

    content: dict[Any, Any]


def _fields_of(piece: object) -> dict[str, Any]:
    kind: type = type(piece)
    return {name: getattr(piece, name) for name in field_names(kind)}


def capture(state: State, rest: dict[str, object]) -> Taken:
    """Captures the estimator state and the ``rest``, which may refer to the same objects.

    The duration grows with the number of submaps and keyframes; docs/performance.md has figures.

    Raises:
        CannotTake: some part cannot be pickled.
    """
    taken = Taken()
    taken.hold_all(set(map(_submap_of, state.map.keyframes.values())).union(state.map.graph.submaps.values()))
    if (aside := state.map.parts.aside) is not None:
        taken.hold_all(set(map(_submap_of, aside.frames.values())).union(aside.submaps.values()))
    try:
        taken.seal({"state": state, "rest": rest})
    except (TypeError, AttributeError, ValueError, pickle.PicklingError, RecursionError) as error:
        raise CannotTake(f"the state cannot be taken: {error}") from error
    return taken


class _Writer(pickle.Pickler):
    """Pickler that writes references in place of pieces."""

    def __init__(self, file: io.BytesIO, taken: Taken) -> None:
        super().__init__(file, PROTOCOL)
        self._taken = taken

    def reducer_override(self, obj: object) -> Any:
        """Returns the reduction of objects that pickle does not store by itself."""
        kept = _KEPT.get(type(obj))
        if kept is not None:
            return kept(obj, self._taken)
        if isinstance(obj, Enum):  # Python 3.11.0 to 3.11.3 name members by getattr, which a state must not call
            return type(obj), (obj.value,)
        return NotImplemented


def _pickled(what: object, taken: Taken) -> bytes:
    file = io.BytesIO()
    _Writer(file, taken).dump(what)
    return file.getvalue()


def _keep_state(state: State, taken: Taken) -> Any:
    said = _fields_of(state)
    said["journal"] = None
    return blank, (State,), said, None, None, fill


def _keep_map(map_: MapState, taken: Taken) -> Any:
    said = _fields_of(map_)
    said["keyframes"] = taken.hold(map_.keyframes.copy())
    said["places"] = taken.hold({place: tuple(keys) for place, keys in map_.places.items()})
    return blank, (MapState,), said, None, None, fill


def _keep_matching(matching: MatchMemory, taken: Taken) -> Any:
    said = _fields_of(matching)
    if matching.bearing_rad is not None:
        said["bearing_rad"] = taken.hold(matching.bearing_rad)
    return blank, (MatchMemory,), said, None, None, fill


def _keep_graph(graph: SubmapGraph, taken: Taken) -> Any:
    said = _fields_of(graph)
    said["submaps"] = taken.hold(graph.submaps.copy())
    said["ties"] = taken.hold(graph.ties.copy())
    return blank, (SubmapGraph,), said, None, None, fill


def _keep_aside(aside: SearchedAside, taken: Taken) -> Any:
    said = _fields_of(aside)
    said["submaps"], said["frames"] = taken.hold(aside.submaps), taken.hold(aside.frames)  # neither is ever changed
    return blank, (SearchedAside,), said, None, None, fill


def _keep_function(function: types.FunctionType, taken: Taken) -> Any:
    if "<" not in function.__qualname__:
        return NotImplemented
    held = tuple(cell.cell_contents for cell in function.__closure__ or ())
    names = function.__module__, function.__qualname__, function.__code__.co_firstlineno
    return function_within, (*names, held, function.__defaults__)


def _keep_piece(piece: object, taken: Taken) -> Any:
    return piece_of, (taken.hold(piece).number,)


_KEPT: Final[dict[type, Callable[[Any, Taken], Any]]] = {
    **dict.fromkeys((Submap, Survey, ResidualMap, *FIXED), _keep_piece),
    State: _keep_state,
    MapState: _keep_map,
    MatchMemory: _keep_matching,
    SubmapGraph: _keep_graph,
    SearchedAside: _keep_aside,
    types.FunctionType: _keep_function,
    WeakSet: lambda held, taken: (weak_set, (tuple(held),)),
    _Ref: lambda ref, taken: (piece_of, (ref.number,)),
    _Dict: lambda one, taken: (dict, (), None, None, iter(one.content.items())),
}
