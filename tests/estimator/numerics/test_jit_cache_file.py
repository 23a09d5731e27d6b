"""Files of compiled kernels after a power cut, a failing disk or a stranger: compiled again, once, and never fatal."""

import errno
import json
import os
import pickle
import random
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from estimator.numerics import jit_cache_file
from estimator.numerics.jit_cache_file import CACHE_REPORT, _CheckedFile, read_checked, write_checked

ROOT = Path(__file__).parents[3]
KEY, OTHER = ("f8(f8)", "cpu"), ("f8(i8)", "cpu")


def replaced(content: Callable[[bytes], bytes]) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(content(path.read_bytes())) and None


def bit_flipped(data: bytes, at: int) -> bytes:
    return data[:at] + bytes([data[at] ^ 0x10]) + data[at + 1 :]


def in_place(make: Callable[[Path], object]) -> Callable[[Path], None]:
    def damage(path: Path) -> None:
        path.unlink()
        make(path)

    return damage


def with_valid_digest(content: bytes) -> Callable[[Path], None]:
    return lambda path: write_checked(str(path), content)


DAMAGES: dict[str, Callable[[Path], None]] = {
    "empty": replaced(lambda data: b""),
    "one byte": replaced(lambda data: data[:1]),
    "half": replaced(lambda data: data[: len(data) // 2]),
    "all but one": replaced(lambda data: data[:-1]),
    "bytes long instead of": replaced(lambda data: data + b"\0"),
    "zeros": replaced(lambda data: bytes(len(data))),
    "second half zeros": replaced(lambda data: data[: len(data) // 2] + bytes(len(data) - len(data) // 2)),
    "first bit": replaced(lambda data: bit_flipped(data, 0)),
    "middle bit": replaced(lambda data: bit_flipped(data, len(data) // 2)),
    "last bit": replaced(lambda data: bit_flipped(data, len(data) - 1)),
    "garbage": replaced(lambda data: random.Random(1).randbytes(len(data))),
    "endless": in_place(lambda path: path.symlink_to("/dev/zero")),
    "huge": lambda path: os.truncate(path, jit_cache_file.MOST_BYTES + 1),
    "folder": in_place(lambda path: path.mkdir()),
    "folder with a file": in_place(lambda path: (path.mkdir(), (path / "a").touch())),
    "fifo": in_place(os.mkfifo),
    "loop": in_place(lambda path: path.symlink_to(path.name)),
    "dangling": in_place(lambda path: path.symlink_to("nowhere")),
    "no pickle": with_valid_digest(b"no pickle"),
    "nested": with_valid_digest(b"(" * 100_000),
    "other kind": with_valid_digest(pickle.dumps(7)),
}


@pytest.fixture(autouse=True)
def report() -> jit_cache_file.CacheReport:
    CACHE_REPORT.damaged.clear()
    CACHE_REPORT.unwritten = ""
    return CACHE_REPORT


def file_in(folder: Path) -> Any:
    return _CheckedFile(cache_path=str(folder), filename_base="name", source_stamp=b"stamp")


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    for key, data in ((KEY, [1, 2]), (OTHER, [3]), (KEY, [4])):
        file_in(tmp_path).save(key, data)
    assert file_in(tmp_path).load(KEY) == [4]
    assert file_in(tmp_path).load(OTHER) == [3]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["name.1.nbc", "name.2.nbc", "name.nbi"]
    assert jit_cache_file.CacheReport() == CACHE_REPORT


def test_files_of_other_sources_are_none(tmp_path: Path) -> None:
    file_in(tmp_path).save(KEY, [1])
    other = _CheckedFile(cache_path=str(tmp_path), filename_base="name", source_stamp=b"another")
    assert other.load(KEY) is None
    assert not CACHE_REPORT.damaged


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("name", DAMAGES)
@pytest.mark.timeout(20)
def test_a_damaged_file_counts_as_missing_and_is_written_anew(tmp_path: Path, name: str, suffix: str) -> None:
    file_in(tmp_path).save(KEY, [1, 2])
    (spoilt,) = tmp_path.glob(f"*.{suffix}")
    DAMAGES[name](spoilt)
    assert file_in(tmp_path).load(KEY) in (None, 7), "what is whole and no kernel is refused when it is rebuilt"
    file_in(tmp_path).save(KEY, [5])
    assert file_in(tmp_path).load(KEY) == [5]
    assert len(list(tmp_path.iterdir())) == 2, "nothing is left beside them"
    if name not in ("dangling", "other kind"):
        assert list(CACHE_REPORT.damaged) == [str(spoilt)]


@pytest.mark.parametrize("call", ["open", "fstat", "fsync"])
@pytest.mark.parametrize("number", [errno.EIO, errno.EACCES, errno.ENOSPC, errno.ENOMEM])
def test_a_call_that_fails_costs_one_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, number: int
) -> None:
    """Reading counts it as damaged; writing raises, and leaves nothing half."""
    file_in(tmp_path).save(KEY, [1])

    def fails(*_: object) -> int:
        raise OSError(number, os.strerror(number))

    with monkeypatch.context() as failing:
        failing.setattr(os, call, fails)
        if call == "fsync":
            with pytest.raises(OSError, match=os.strerror(number)):
                file_in(tmp_path).save(OTHER, [2])
        else:
            assert file_in(tmp_path).load(KEY) is None
            assert list(CACHE_REPORT.damaged.values()) == [os.strerror(number)]
    assert file_in(tmp_path).load(KEY) == [1]
    assert len(list(tmp_path.iterdir())) == 2


def test_machine_code_is_on_the_disk_before_the_index_that_names_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    order: list[str] = []
    sync, replace = os.fsync, Path.replace
    monkeypatch.setattr(os, "fsync", lambda handle: (order.append("synced"), sync(handle))[1])
    monkeypatch.setattr(Path, "replace", lambda path, to: (order.append(Path(to).suffix), replace(path, to))[1])
    file_in(tmp_path).save(KEY, [1])
    assert order == ["synced", ".nbc", "synced", ".nbi"]


def test_a_missing_file_is_no_damage(tmp_path: Path) -> None:
    assert read_checked(str(tmp_path / "name")) is None
    assert not CACHE_REPORT.damaged


def test_whatever_reads_damaged_files_logs_the_first_of_them(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Also a command that trusts the mark of an earlier start."""
    for name in ("first", "second"):
        (tmp_path / name).write_bytes(b"")
        read_checked(str(tmp_path / name))
    assert [record.getMessage().partition(":")[0] for record in caplog.records] == [f"{tmp_path}/first cannot be used"]
    assert len(CACHE_REPORT.damaged) == 2


KERNELS = "import numpy as np\nfrom estimator.numerics.jit import kernel\n" + "\n".join(
    f'@kernel("f8(f8)")\ndef plus_{k}(x):\n    return x + {k}.0\n' for k in range(len(DAMAGES))
)
ASK = """
import json
from numba.core import event
seen = []
class Count(event.Listener):
    def on_start(self, _): seen.append(1)
    def on_end(self, _): pass
event.register("numba:compile", Count())
import many
from estimator import CACHE_REPORT
values = [getattr(many, name)(1.0) for name in sorted(vars(many)) if name.startswith("plus_")]
print(json.dumps([len(seen), sum(values), sorted(CACHE_REPORT.damaged), CACHE_REPORT.unwritten]))
"""


def ask(folder: Path) -> list[Any]:
    (folder / "many.py").write_text(KERNELS)
    places = {"NUMBA_CACHE_DIR": str(folder / "cache"), "PYTHONPATH": f"{ROOT}:{folder}"}
    words = [sys.executable, "-c", ASK]
    done = subprocess.run(words, env={**os.environ, **places}, capture_output=True, text=True, timeout=120.0)
    assert done.returncode == 0, done.stderr
    compiled, total, damaged, unwritten = json.loads(done.stdout)
    assert total == sum(1.0 + k for k in range(len(DAMAGES)))
    return [compiled, damaged, unwritten]


@pytest.mark.jit
def test_kernels_with_damaged_files_are_compiled_again_and_only_those(tmp_path: Path) -> None:
    assert ask(tmp_path) == [len(DAMAGES), [], ""]
    for suffix in ("nbc", "nbi"):
        spoilt = sorted((tmp_path / "cache").rglob(f"*.{suffix}"))
        assert len(spoilt) == len(DAMAGES)
        for path, damage in zip(spoilt[1:], list(DAMAGES.values())[1:], strict=True):
            damage(path)
        compiled, damaged, unwritten = ask(tmp_path)
        assert compiled == len(DAMAGES) - 1
        assert len(damaged) >= len(DAMAGES) - 3, "all but a missing file and an index of another format"
        assert unwritten == ""
        assert ask(tmp_path) == [0, [], ""]


@pytest.mark.jit
def test_kernels_that_cannot_be_stored_are_compiled_all_the_same(tmp_path: Path) -> None:
    ask(tmp_path)
    (folder,) = (tmp_path / "cache").glob("kernels-*/*_*")
    elsewhere = folder.rename(tmp_path / "elsewhere")
    folder.symlink_to("/proc")  # no file can be made there
    compiled, _, unwritten = ask(tmp_path)
    assert compiled == len(DAMAGES)
    assert str(folder) in unwritten
    folder.unlink()
    elsewhere.rename(folder)
    assert ask(tmp_path) == [0, [], ""]
