"""Cache files of compiled kernels with a digest: a damaged file counts as missing, and its kernel is compiled again.

numba's cache unpacks whatever a file contains. After a power cut a file may be empty, cut or full of zeros, and every
start would fail at it. So each file ends with a digest of its content, which is checked before anything is unpacked. It
is synced before it receives its name, and the machine code is written before the index that refers to it. A file that
cannot be written costs time at the next start and nothing else. `CACHE_REPORT` collects both kinds of trouble.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import shutil
import stat
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final
from uuid import uuid4

from numba.core import caching

log = logging.getLogger(__name__)

_upstream: Any = caching  # untyped
_MAGIC: Final = b"LLK1"
_DIGEST_BYTES: Final = 16
_ROOM: Final = Path(__file__).parents[1]
MOST_BYTES: Final = 64 << 20
"""Largest size of a file in bytes; the largest kernel has less than one percent of it."""


@dataclass
class CacheReport:
    """Trouble with the cache files in this process.

    Attributes:
        damaged: reason by path of each file that exists and cannot be used. unwritten: reason why the last file could
            not be written, empty: none failed.
    """

    damaged: dict[str, str] = field(default_factory=dict)
    unwritten: str = ""


CACHE_REPORT: Final = CacheReport()


class _Unusable(Exception):
    """A file whose content is damaged; the text gives the reason."""


def _digest(content: bytes) -> bytes:
    return _MAGIC + hashlib.blake2b(content, digest_size=_DIGEST_BYTES).digest()


def read_checked(path: str) -> bytes | None:
    """Content of a cache file without its digest; None if it is missing or, with an entry in the report, unusable."""
    try:
        return _checked(_content(path))
    except FileNotFoundError:
        return None
    except (OSError, _Unusable) as error:
        note_damage(path, getattr(error, "strerror", None) or str(error))
        return None


def note_damage(path: str, reason: str) -> None:
    """Report a file as damaged; the first reason stays. The first file is logged, whichever program reads it."""
    if not CACHE_REPORT.damaged:
        log.warning("%s cannot be used: %s; the daemon compiles the affected kernels again", path, reason)
    CACHE_REPORT.damaged.setdefault(path, reason)


def note_unwritten(reason: str) -> None:
    """Report that a file cannot be written; the first is logged."""
    if not CACHE_REPORT.unwritten:
        log.warning("%s; compiled kernels cannot be stored, so each start compiles them", reason)
    CACHE_REPORT.unwritten = reason


def _content(path: str) -> bytes:
    """Bytes of a regular file; a FIFO or a device without a writer never blocks."""
    handle = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        about = os.fstat(handle)
        if not stat.S_ISREG(about.st_mode):
            raise _Unusable("it is not a regular file")
        if about.st_size > MOST_BYTES:
            raise _Unusable(f"it has {about.st_size} bytes")
        with os.fdopen(handle, "rb", closefd=False) as file:
            return file.read(MOST_BYTES)
    finally:
        os.close(handle)


def _checked(content: bytes) -> bytes:
    body, tail = content[: -len(_MAGIC) - _DIGEST_BYTES], content[-len(_MAGIC) - _DIGEST_BYTES :]
    if not content:
        raise _Unusable("it is empty")
    if tail != _digest(body):
        raise _Unusable("its digest does not match its content")
    return body


def write_checked(path: str, content: bytes) -> None:
    """Write a cache file with its digest atomically, and sync it; an alien folder of that name is removed."""
    there, beside = Path(path), Path(f"{path}.tmp.{uuid4().hex[:16]}")
    try:
        with beside.open("xb") as file:
            file.write(content)
            file.write(_digest(content))
            file.flush()
            os.fsync(file.fileno())
        if there.is_dir() and not there.is_symlink():
            shutil.rmtree(there)
        beside.replace(there)
    except OSError:
        with suppress(OSError):
            beside.unlink()
        raise


class _CheckedFile(_upstream.IndexDataCacheFile):  # type: ignore[misc]  # untyped upstream
    """Index and machine code of one function."""

    def save(self, key: Any, data: Any) -> None:
        """Write the machine code, then the index, unless it contains this signature already."""
        names = self._load_index()
        numbered = (self._data_name(number) for number in range(1, len(names) + 2))
        name = names.get(key) or next(name for name in numbered if name not in names.values())
        write_checked(self._data_path(name), self._dump(data))
        if key not in names:
            self._save_index({**names, key: name})

    def _load_index(self) -> dict[Any, str]:
        found = _unpacked(self._index_path)
        if not isinstance(found, tuple) or found[:2] != (self._version, self._source_stamp):
            return {}
        return dict(found[2])

    def _save_index(self, overloads: dict[Any, str]) -> None:
        write_checked(self._index_path, self._dump((self._version, self._source_stamp, overloads)))

    def _load_data(self, name: str) -> Any:
        return _unpacked(self._data_path(name))


def _unpacked(path: str) -> Any:
    """Object in a cache file; None if the file is missing or, with an entry in the report, unusable."""
    content = read_checked(path)
    if content is None:
        return None
    try:
        return pickle.loads(content)
    except MemoryError:
        raise
    except Exception as error:  # noqa: BLE001  a pickle may raise anything
        note_damage(path, repr(error))
        return None


class _Locator(_upstream.UserProvidedCacheLocator):  # type: ignore[misc]  # untyped upstream
    """Directory of a function's files, which need not be writable before something is written."""

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        return cls(py_func, py_file)

    @classmethod
    def get_suitable_cache_subpath(cls, py_file: str) -> str:
        """Name of the folder; for the estimator's own files it is the same wherever they are installed."""
        folder = Path(py_file).parent
        if folder.is_relative_to(_ROOM):
            return "_".join(reversed(folder.relative_to(_ROOM.parent).parts))
        return str(super().get_suitable_cache_subpath(py_file))

    def get_source_stamp(self) -> Any:
        """Stamp of a source file; the cache directory is named by the content of the estimator's files."""
        return "estimator" if Path(self._py_file).is_relative_to(_ROOM) else super().get_source_stamp()

    def ensure_cache_path(self) -> None:
        path = Path(self.get_cache_path())
        try:
            path.mkdir(parents=True, exist_ok=True)
        except FileExistsError:  # no folder
            path.unlink()
            path.mkdir()


class _Files(_upstream.CompileResultCacheImpl):  # type: ignore[misc]  # untyped upstream
    _locator_classes = (_Locator,)


class KernelCache(_upstream.FunctionCache):  # type: ignore[misc]  # untyped upstream
    """Cache of one function's compiled signatures, which never makes a start fail."""

    _impl_class = _Files

    def __init__(self, py_func: Any) -> None:
        super().__init__(py_func)
        stamp, name = self._impl.locator.get_source_stamp(), self._impl.filename_base
        self._cache_file = _CheckedFile(cache_path=self._cache_path, filename_base=name, source_stamp=stamp)

    def _load_overload(self, sig: Any, target_context: Any) -> Any:
        try:
            return super()._load_overload(sig, target_context)
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001  whatever a file contains: its kernel can be compiled again
            note_damage(self._cache_file._index_path, repr(error))
            return None

    def _save_overload(self, sig: Any, data: Any) -> None:
        try:
            super()._save_overload(sig, data)
        except OSError as error:
            note_unwritten(f"{self._cache_path}: {error.strerror or error}")


REPLACES_UPSTREAM: Final = all(
    hasattr(_upstream.IndexDataCacheFile, name) for name in ("load", "_dump", "_data_name", "_data_path")
) and all(hasattr(_upstream.FunctionCache, name) for name in ("_load_overload", "_save_overload"))
"""Whether this version of numba has the parts that `KernelCache` replaces; otherwise numba's own cache is used."""
