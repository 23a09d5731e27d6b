"""A state file from anywhere: what it may make, what it may call, and what it may set."""

from __future__ import annotations

import functools
import io
import pickle
from collections.abc import Callable
from typing import Any, ClassVar

import numpy as np
import pytest

from daemon.health.faults import Fault
from daemon.integrity.input_monitor import Watch
from daemon.integrity.state_memory import Memory
from daemon.recording import restore as reading
from daemon.recording.checkpoint import Taken
from daemon.recording.restore import ROOT, CannotRestore, Piece, function_within, restore
from daemon.snapshot import State as Said
from estimator.lazy_exports import exports_of
from estimator.measurements import DegradationLevel, Limits
from estimator.numerics import se2


def taken(content: bytes) -> None:
    """What reading such a root leads to."""
    restore(iter([Piece(ROOT, "", content)]))


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("os", "system"),
        ("subprocess", "Popen"),
        ("builtins", "eval"),
        ("builtins", "getattr"),
        ("daemon.cli.parser", "main"),
        ("daemon.recording.disk_writer", "SegmentWriter"),
        ("daemon.devices.conversion", "re"),
        ("estimator.measurements", "np"),
        ("estimator.lazy_exports", "exports_of"),
        ("estimator.numerics.jit", "kernel"),
        ("estimator.measurements", "np.ctypeslib.os.system"),
    ],
)
def test_a_state_makes_nothing_but_what_a_state_consists_of(module: str, name: str) -> None:
    words = b"".join(pickle.SHORT_BINUNICODE + bytes([len(word)]) + word.encode() for word in (module, name))
    with pytest.raises(CannotRestore, match="does not belong"):
        taken(pickle.PROTO + b"\x05" + words + pickle.STACK_GLOBAL + pickle.STOP)


@pytest.mark.parametrize(
    ("module", "qualname"),
    [("os", "popen.<locals>.x"), ("estimator.lazy_exports", "exports_of.<locals>.package_getattr")],
)
def test_a_state_takes_no_functions_from_elsewhere(module: str, qualname: str) -> None:
    lines = [code.co_firstlineno for code in exports_of.__code__.co_consts if hasattr(code, "co_firstlineno")]
    for line in (1, *lines):
        with pytest.raises(CannotRestore, match="does not belong"):
            function_within(module, qualname, line, ({"os": ("path", "os")}, "os"), None)


# --- forged ones: each command of pickle is written by hand, as no honest writer would -------------------------------


class Forge(pickle._Pickler):
    """Writes ``BUILD`` and ``REDUCE`` with whatever they are given."""

    dispatch: ClassVar[dict[type, Callable[..., None]]] = dict(pickle._Pickler.dispatch)

    def build(self, order: Build) -> None:
        """An object or a class, its state, and the command to set it."""
        self.save(order.what)
        self.save(order.said)
        self.write(pickle.BUILD)

    def call(self, order: Call) -> None:
        """A function, what it is given, and the command to call it."""
        self.save(order.what)
        self.save(order.given)
        self.write(pickle.REDUCE)


class Build:
    """Stands for an object that is filled."""

    def __init__(self, what: object, said: object) -> None:
        self.what, self.said = what, said


class Call:
    """Stands for what a function returns."""

    def __init__(self, what: object, *given: object) -> None:
        self.what, self.given = what, given


Forge.dispatch[Build] = Forge.build
Forge.dispatch[Call] = Forge.call


def forged(what: object) -> bytes:
    file = io.BytesIO()
    Forge(file, 5).dump(what)
    return file.getvalue()


def new(kind: type) -> Call:
    """An object of a class, without its fields."""
    return Call(reading.blank, kind)


FORGED = {
    "a method of a class": Build(Watch, (None, {"on_scan": "x"})),
    "a field of a class": Build(Watch, (None, {"late": 7})),
    "a method of an object": Build(new(Watch), {"on_scan": "x"}),
    "a method of an object, by its slots": Build(new(Watch), (None, {"on_scan": "x"})),
    "the class of an object": Build(new(Watch), (None, {"__class__": Limits})),
    "something that is no field": Build(new(Limits), {"anything": 1}),
    "fields that are too many": Build(new(Limits), [0] * 40),
    "a member of an enumeration": Build(Fault.LIDAR_SILENT, {"_value_": 0}),
    "a member of another": Build(DegradationLevel.FULL, (None, {"_value_": 3})),
    "a function of the estimator": Build(se2.compose, (None, {"__defaults__": (1,)})),
    "a function of the reader": Build(reading.blank, (None, {"__defaults__": (1,)})),
    "a function, by the reader's own": Call(reading.fill, se2.compose, {"__defaults__": (1,)}),
    "a class, by the reader's own": Call(reading.fill, Watch, {"on_scan": 1}),
    "a method, by the reader's own": Call(reading.fill, new(Watch), {"on_odometry": 1}),
    "a call of the estimator": Call(se2.compose, 1, 2),
    "a call of what was made": Call(Call(functools.partial, Watch), "x"),
    "a call with nobody to call": Call("text", 1),
    "an object of a class elsewhere": Call(reading.blank, dict),
    "a partial's attributes": Build(Call(functools.partial, Watch), (Watch, (), None, {"x": 1})),
    "a struct with fewer fields": Call(Memory, 3, 0),
    "memory by numpy": Call(np.ndarray, (1 << 20,), "O", b"12345678"),
    "objects by numpy": Call(np.dtype, "O"),
    "a dtype that all share": Build(Call(np.dtype, "f8"), (3, ">", None, None, None, -1, -1, 0)),
    "a dtype with fields": Build(Call(np.dtype, "f8"), (3, "<", None, ("x",), {"x": ("f8", 0)}, 8, 1, 0)),
    "more memory than there is": Call(bytearray, 1 << 62),
    "more than can be counted": Call(bytearray, 1 << 70),
    "a root that is none": {"state": Said.TRACKING, "rest": {}},
    "another root": [1, 2, 3],
}


@pytest.mark.parametrize("what", FORGED.values(), ids=FORGED)
def test_a_forged_state_is_refused_and_changes_nothing(what: object) -> None:
    before = dict(vars(Watch)), se2.compose.__defaults__, reading.blank.__defaults__, Fault(101)._value_
    with pytest.raises(CannotRestore, match=r"made by another version, or damaged|does not belong"):
        taken(forged(what))
    assert (dict(vars(Watch)), se2.compose.__defaults__, reading.blank.__defaults__, Fault(101)._value_) == before
    assert np.dtype("f8").isnative


@pytest.mark.parametrize(
    "command", [b"(cdaemon.watch\nWatch\no", b"(idaemon.watch\nWatch\n", b"Pname\n", b"\x82\x01", b"J\x01"]
)
def test_commands_that_no_state_needs_are_none(command: bytes) -> None:
    with pytest.raises(CannotRestore):
        taken(pickle.PROTO + b"\x05" + command + pickle.STOP)


def test_what_is_honest_comes_back() -> None:
    watch = Watch()
    watch.late = 3
    honest: dict[str, Any] = {
        "watch": watch,
        "limits": Limits(5, 100, update_map=False, level=DegradationLevel.CARRIED),
        "fault": Fault.LIDAR_SILENT,
        "arrays": [np.arange(6.0).reshape(2, 3)[:, ::2], np.zeros(0, np.uint8), np.float64(1.5), np.array(["ab"])],
        "partial": functools.partial(se2.compose, 1),
    }
    taken = Taken()
    taken.seal(honest)
    (root,) = taken.pieces()
    assert root.number == ROOT
    back = reading._Reader(root.content, {}.__getitem__).load()
    assert vars(back["watch"]).keys() == vars(watch).keys()
    assert back["watch"].late == 3
    assert (back["limits"], back["fault"]) == (honest["limits"], Fault.LIDAR_SILENT)
    for one, other in zip(back["arrays"], honest["arrays"], strict=True):
        assert one.dtype == other.dtype
        assert np.array_equal(one, other)
    assert back["partial"].func is se2.compose


def test_what_other_software_has_written_with_fewer_fields_is_refused_by_name() -> None:
    """Else it would fail in the middle of a replay, for want of an attribute."""
    with pytest.raises(pickle.UnpicklingError, match="Limits lacks 'icp_iterations': other software"):
        reading.fill(reading.blank(Limits), {"points": 1})
    with pytest.raises(CannotRestore, match="Memory: not all of its fields, or more"):
        taken(forged(Call(Memory, 3, 0)))
