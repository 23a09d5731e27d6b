"""A state file from anywhere: what it may make, and that no file takes more memory or time than its size allows."""

import pickle
import subprocess
import sys
import time
from collections import deque
from collections.abc import Iterable
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any
from weakref import WeakSet

import msgspec
import numpy as np
import pytest

from daemon.health.faults import Fault
from daemon.integrity.input_monitor import Watch
from daemon.recording import checkpoint, restore, state_file
from daemon.recording.checkpoint import CannotTake, Taken
from daemon.recording.restore import CannotRestore, build
from daemon.recording.state_file import BadState, read_state, write_state
from daemon.recording.state_schema import (
    Array,
    Call,
    Kind,
    Many,
    Member,
    Node,
    Record,
    Ref,
    Table,
    function_of,
)
from daemon.snapshot import State as Said
from estimator.mapping.keyframe import settle
from estimator.mapping.live_grid import Drawn
from estimator.measurements import DegradationLevel, Limits
from estimator.numerics import se2
from hal.errors import DeviceFault

ROOT = Path(__file__).parents[3]


def described(what: object) -> list[Node]:
    taken = Taken()
    taken.seal(what)
    return list(taken.nodes())


def back(what: object) -> Any:
    return build(described(what))


class Loop:
    """Attributes in a circle."""


def test_what_is_honest_comes_back() -> None:
    watch, shared = Watch(), [1, "text", None]
    watch.late = 3
    drawn = Drawn(*range(len(Drawn._fields)))  # type: ignore[arg-type]  # any content
    honest: dict[str, Any] = {
        "watch": watch,
        "limits": Limits(5, 100, update_map=False, level=DegradationLevel.CARRIED),
        "fault": Fault.LIDAR_SILENT,
        "arrays": [np.arange(6.0).reshape(2, 3)[:, ::2], np.zeros((0, 3), np.uint8), np.array(["ab"]), np.array(5)],
        "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "number": np.float32(1.5),
        "job": partial(settle, (1, 2), 3.0),
        "shared": [shared, shared],
        "deque": deque([1, 2, 3], maxlen=4),
        "sets": [{1, 2.5}, frozenset({(1, "a"), (2, "b")}), (Fault.LIDAR_SILENT, ())],
        "keys": {(1, 2): b"x", Fault.LIDAR_SILENT: [], None: float("inf"), -(1 << 63): (1 << 64) - 1},
        "error": DeviceFault("/dev/x", "it burns", "water"),
        "drawn": drawn,
    }
    honest["circle"] = honest["shared"]
    honest["shared"].append(honest["shared"])
    found = back(honest)
    assert vars(found["watch"]).keys() == vars(watch).keys()
    assert found["watch"].late == 3
    for name in ("limits", "fault", "deque", "sets", "keys", "drawn"):
        assert found[name] == honest[name]
        assert type(found[name]) is type(honest[name])
    assert found["deque"].maxlen == 4
    for one, other in zip([*found["arrays"], found["columns"]], [*honest["arrays"], honest["columns"]], strict=True):
        assert (one.dtype, one.shape) == (other.dtype, other.shape)
        assert np.array_equal(one, other)
        assert one.flags.writeable
    assert found["columns"].flags.f_contiguous
    assert type(found["number"]) is np.float32
    assert (found["number"], str(found["error"])) == (1.5, "/dev/x: it burns (water)")
    assert (found["job"].func, found["job"].args) == (settle, ((1, 2), 3.0))
    assert found["shared"][0] is found["shared"][1]
    assert found["circle"] is found["shared"]
    assert found["shared"][2] is found["shared"]


def test_elements_of_a_weak_set_are_those_of_the_state() -> None:
    one, other = Watch(), Watch()
    found = back({"all": [one, other], "weak": WeakSet([other])})
    assert list(found["weak"]) == [found["all"][1]]


@pytest.mark.parametrize(
    "what",
    [lambda: 1, se2.compose, Path("x"), Loop(), object(), 1 << 64, {"x": partial(settle, sigma=1)}, np.array([{}])],
)
def test_what_belongs_into_no_state_is_refused_when_it_is_written(what: object) -> None:
    with pytest.raises(CannotTake):
        described([what])


def test_a_copy_in_this_process_never_leaves_it() -> None:
    """Pickle copies; the file has none of it."""
    encoded = msgspec.msgpack.encode(described({"limits": Limits(5, 100, True)}))
    assert pickle.PROTO + b"\x05" not in encoded
    assert b"daemon" not in encoded, "no module path"
    assert b"estimator.Limits" in encoded, "a group and a class"


# --- forged ones -----------------------------------------------------------------------------------------------------

LIMITS = ("icp_iterations", "points", "update_map", "codes", "level")


def chain(length: int, width: int = 1) -> list[Node]:
    """Tuples in one another; the last one is empty."""
    return [*(Many("tuple", [Ref(number + 1)] * width) for number in range(length)), Many("tuple", [])]


def within(outer: Node, nodes: list[Node]) -> list[Node]:
    """The same nodes behind another, which refers to the first of them as node 1."""

    def moved(value: object) -> object:
        return Ref(value.node + 1) if isinstance(value, Ref) else value

    return [outer, *(Many(node.form, [moved(item) for item in node.items]) for node in nodes if isinstance(node, Many))]  # type: ignore[misc]


FORGED: dict[str, list[Node]] = {
    "nothing": [],
    "a class elsewhere": [Record(1, []), Kind("os.PathLike", ())],
    "a class of another module": [Record(1, []), Kind("recording.SegmentWriter", ())],
    "a module's import": [Record(1, []), Kind("cycle.Path", ())],
    "a class within a class": [Record(1, []), Kind("estimator.State.x", ())],
    "a field too few": [Record(1, [1]), Kind("estimator.Limits", ("points",))],
    "a field too many": [Record(1, [1] * 9), Kind("estimator.Limits", (*LIMITS, "more"))],
    "values too few": [Record(1, []), Kind("cycle.Watch", ("late",))],
    "a method": [Record(1, [1]), Kind("cycle.Watch", ("on_scan",))],
    "the class of an object": [Record(1, [1]), Kind("cycle.Watch", ("__class__",))],
    "a field twice": [Record(1, [1, 2]), Kind("cycle.Watch", ("late", "late"))],
    "a record of an enumeration": [Record(1, [1]), Kind("cycle.Fault", ("_value_",))],
    "a record without a class": [Record(0, [])],
    "a record of a class that is none": [Record(7, [])],
    "a class as a value": [Many("list", [Ref(1)]), Kind("cycle.Watch", ())],
    "a member of a class": [Member("cycle.Watch", 1)],
    "a member that is none": [Member("cycle.Fault", 123456)],
    "a function elsewhere": [Call("os.system", ["true"])],
    "a function that no job has": [Call("numerics.compose", [1, 2])],
    "a class as a function": [Call("cycle.Watch", [])],
    "a reference to nothing": [Many("list", [Ref(9)])],
    "a reference before the first": [Many("list", [Ref(-1)])],
    "a container that is none": [Many("bytearray", [1 << 40])],
    "an array of objects": [Array("O", (1,), "C", bytes(8))],
    "an array with fields": [Array("i4,i4", (1,), "C", bytes(8))],
    "an array of arrays": [Array("(1000000000,)f8", (1,), "C", bytes(8))],
    "an array larger than its bytes": [Array("f8", (1 << 40,), "C", bytes(8))],
    "an array of no size": [Array("f8", (-1, -1), "C", bytes(8))],
    "an array without bytes": [Array("S0", (1 << 40,), "C", b"")],
    "an array of too many dimensions": [Array("f8", (1,) * 1000, "C", bytes(8))],
    "a number of several": [Array("f8", (2,), "C", bytes(16), True)],
    "a tuple in itself": [Many("tuple", [Ref(0)])],
    "tuples without end": chain(100_000),
    "a key that is a list": [Table([Ref(1)], [1]), Many("list", [])],
    "a key that takes for ever": within(Table([Ref(1)], [1]), chain(60, 2)),
    "an element that takes for ever": within(Many("set", [Ref(1)]), chain(60, 2)),
    "a frozen one that takes for ever": within(Many("frozenset", [Ref(1)]), chain(60, 2)),
    "keys without values": [Table([1, 2], [1])],
    "a root that is none": [Table(["state", "rest"], [Ref(1), Ref(2)]), Member("cycle.State", 1), Table([], [])],
    "another root": [Many("list", [1, 2, 3])],
}


@pytest.mark.parametrize("nodes", FORGED.values(), ids=FORGED)
def test_a_forged_state_is_refused_and_changes_nothing(nodes: list[Node]) -> None:
    before = dict(vars(Watch)), se2.compose.__defaults__, Fault(101)._value_
    begun = time.perf_counter()
    with pytest.raises(CannotRestore, match=r"made by another version, or damaged"):
        restore.restore(nodes)
    assert time.perf_counter() - begun < 5.0
    assert (dict(vars(Watch)), se2.compose.__defaults__, Fault(101)._value_) == before
    assert Said(1) in Said


def test_what_other_software_has_written_with_other_fields_is_refused_by_name() -> None:
    """Else it would fail in the middle of a replay, for want of an attribute."""
    nodes = [Record(1, [1, 2]), Kind("estimator.Limits", ("points", "patience"))]
    with pytest.raises(CannotRestore, match=r"Limits has other fields in this version: .*patience"):
        restore.restore(nodes)


def test_more_nodes_than_any_state_has_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(restore, "MOST_NODES", 1000)
    with pytest.raises(CannotRestore, match="more than 1000 nodes"):
        restore.restore(Many("list", []) for _ in iter(int, 1))


# --- and their files -------------------------------------------------------------------------------------------------


def written(path: Path, nodes: Iterable[Node]) -> Path:
    write_state(path, {"cycle": 1}, b"line", nodes)
    return path


def test_a_file_has_all_nodes_in_their_order(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_file, "BLOCK_BYTES", 1000)
    nodes: list[Node] = [Many("list", [number]) for number in range(300)]
    header, line, found = read_state(written(tmp_path / "a", nodes))
    assert (header, line, list(found)) == ({"cycle": 1}, b"line", nodes)
    whole = (tmp_path / "a").read_bytes()
    for cut in (1, 30, len(whole) // 2):
        (tmp_path / "a").write_bytes(whole[:-cut])
        with pytest.raises(BadState, match=r"torn|damaged"):
            list(read_state(tmp_path / "a")[2])


def test_a_block_that_is_missing_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(state_file, "BLOCK_BYTES", 1000)
    nodes: list[Node] = [Many("list", [number]) for number in range(300)]
    data = written(tmp_path / "a", nodes).read_bytes()
    size = state_file._BLOCK.size
    at = state_file._header(tmp_path / "a", data)[1]
    at += size + state_file._BLOCK.unpack_from(data, at)[0]  # after the line
    end = at + size + state_file._BLOCK.unpack_from(data, at)[0]
    (tmp_path / "a").write_bytes(data[:at] + data[end:])
    with pytest.raises(BadState, match="damaged"):
        list(read_state(tmp_path / "a")[2])


def test_a_file_that_inflates_to_more_than_any_state_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(state_file, "MOST_BYTES", 1 << 20)
    nodes: list[Node] = [Array("u1", (400_000,), "C", bytes(400_000)) for _ in range(3)]
    with pytest.raises(BadState, match="larger when inflated"):
        list(read_state(written(tmp_path / "a", nodes))[2])


BOMB = """
import resource, struct, sys, zlib
from pathlib import Path
from daemon.recording.restore import CannotRestore, restore
from daemon.recording import state_file
path = Path(sys.argv[1])
REF = b"\\x91\\0"  # a reference to node 0
head = state_file._head({"cycle": 1})
blocks = [state_file._packed(b"line")]
blocks += [state_file._packed(eval(sys.argv[2]))] * int(sys.argv[3])
path.write_bytes(head + b"".join(blocks))
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
try:
    restore(state_file.read_state(path)[2])
except (CannotRestore, state_file.BadState) as error:
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024, path.stat().st_size)
"""


LONG_LIST = "(b'\\x94\\xa4many\\xa4list\\xdd' + struct.pack('>I', 60 << 20) + bytes(60 << 20) + b'\\xc0')"


@pytest.mark.parametrize(
    ("content", "blocks"),
    [
        ("bytes(1 << 28)", 6),  # 1.5 GB of zeros
        ("b'\\xdd' + struct.pack('>I', (1 << 32) - 1)", 1),  # an array of 4e9 nodes, as it says
        ("b'\\x91' * (1 << 20)", 1),  # nested without end
        ("b'\\x91\\x94\\xa4many\\xa4list\\xdd' + struct.pack('>I', 1 << 28) + bytes(1 << 20)", 1),
        (f"b'\\x91' + {LONG_LIST}", 8),
        (f"b'\\x91' + {LONG_LIST.replace('bytes(60 << 20)', '(30 << 20) * REF').replace('60', '30')}", 1),
        ("b'\\xdd' + struct.pack('>I', 60 << 20) + bytes(60 << 20)", 1),  # so many nodes
        (f"b'\\x91' + {LONG_LIST}".replace("x94\\xa4many\\xa4list", "x96\\xa5array\\xa2f8"), 1),  # so many dimensions
        (f"b'\\xdc\\x00\\x3c' + 60 * ({LONG_LIST.replace('60', '1')})", 8),
        ("b'\\x91\\x95\\xa5array\\xa2f8\\x91\\xcf' + struct.pack('>Q', 1 << 60) + b'\\xa1C\\xc4\\x00'", 1),
    ],
)
def test_a_small_file_takes_little_memory(tmp_path: Path, content: str, blocks: int) -> None:
    begun = time.monotonic()
    command = [sys.executable, "-c", BOMB, str(tmp_path / "a"), content, str(blocks)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stderr
    grown_mb, size = map(int, done.stdout.split())
    assert size < 10_000_000
    assert grown_mb < 2 * (state_file.MOST_BYTES >> 20)
    assert time.monotonic() - begun < 60.0


def test_every_function_of_a_job_has_a_name() -> None:
    from estimator import JOB_FUNCTIONS, pipeline  # noqa: F401  loads what queues jobs

    names = [checkpoint.name_of(function) for function in JOB_FUNCTIONS]  # type: ignore[arg-type]  # functions
    assert len(set(names)) == len(names) >= 10
    assert all(function_of(name) in JOB_FUNCTIONS for name in names)
    assert not [pair for pair in product(names, names) if pair[0] == pair[1] + "."]
