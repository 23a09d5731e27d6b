"""What a cycle pays for a state that is taken: little, however many submaps there are."""

from __future__ import annotations

from daemon.checkpoint import take
from daemon.restore import restore
from estimator.mapimage import restored
from estimator.state import State
from tests.daemon.mapmaker import Shape, image


def state(submaps: int, loose: int = 0) -> State:
    return restored(image(Shape(submaps=submaps, frames=1, beams=3, loose=loose)))


def test_what_is_pickled_at_once_does_not_grow_with_the_submaps() -> None:
    few, many = (len(take(state(count, loose=count - 1), {})._root) for count in (4, 104))
    assert many - few < 100, "not even a reference to each"


def test_submaps_are_those_that_were_there_when_it_was_taken() -> None:
    before = state(5)
    keys, places = list(before.atlas.submaps), [submap.place() for submap in before.atlas.submaps.values()]
    taken = take(before, {"one": before.atlas.submaps[keys[2]]})
    del before.atlas.submaps[keys[0]]
    after, rest = restore(taken.pieces())
    assert list(after.atlas.submaps) == keys
    assert rest["one"] is after.atlas.submaps[keys[2]]
    assert all((one.place() == place).all() for one, place in zip(after.atlas.submaps.values(), places, strict=True))
