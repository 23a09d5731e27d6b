"""Residual map file beside the survey: versioned arrays with a checksum and the digest of their survey.

``lights.toml`` has its map in ``lights.residuals.npz``. A map is valid only with the survey it was learned with. A map
of another survey or version, or a damaged one, is rejected with its name; the robot then drives without it.
"""

from __future__ import annotations

import hashlib
import io
import struct
import zipfile
import zlib
from pathlib import Path
from typing import Final

import numpy as np

from daemon.config.survey_loader import dump
from daemon.system.atomic_file import write_whole
from daemon.system.regular_file import read_regular
from estimator import ResidualMap, Survey

VERSION: Final = 1
MOST_BYTES: Final = 256 << 20
"""Largest size of the file in bytes."""
_DAMAGE: Final = (
    *(OSError, EOFError, ValueError, KeyError, TypeError, OverflowError, RuntimeError, MemoryError),
    *(zipfile.BadZipFile, zlib.error, struct.error),
)
"""Exceptions of zipfile and numpy for damaged content."""
_ARRAYS: Final = ("lamp_ids", "grid", "mean", "sigma", "noise")


class ResidualError(Exception):
    """The map cannot be used or written; the text states the reason and the remedy."""


def write_residuals(path: Path, residuals: ResidualMap, survey: Survey) -> None:
    """Write a map atomically; raises `ResidualError`."""
    arrays = {
        "lamp_ids": np.array(residuals.lamp_ids, dtype=np.int64),
        "grid": residuals.grid,
        "mean": residuals.mean,
        "sigma": residuals.sigma,
        "noise": np.array([residuals.noise]),
    }
    file = io.BytesIO()
    facts = {"version": np.array([VERSION]), "survey": np.array(digest(survey)), "check": np.array(_check(arrays))}
    np.savez_compressed(file, allow_pickle=False, **arrays, **facts)
    try:
        write_whole(path, file.getvalue())
    except OSError as error:
        raise ResidualError(f"cannot write {path}: {error.strerror}; free space or name another folder") from error


def read_residuals(path: Path, survey: Survey) -> ResidualMap | None:
    """Read the residual map beside a survey; None where there is none.

    Raises:
        ResidualError: damaged, of another version, or learned with another survey.
    """
    try:
        content = read_regular(path, MOST_BYTES)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ResidualError(f"{path}: not a residual map ({error}); {_AGAIN}") from error
    return unpack(content, survey, str(path))


def unpack(content: bytes, survey: Survey, path: str) -> ResidualMap:
    """Decode a residual map from a file's content; ``path`` names it in errors.

    Raises:
        ResidualError: see :func:`read_residuals`.
    """
    try:
        # numpy does not close a file that it cannot parse
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            kept = {name: file[name] for name in (*_ARRAYS, "version", "survey", "check")}
    except _DAMAGE as error:
        raise ResidualError(f"{path}: not a residual map ({error}); {_AGAIN}") from error
    if kept["version"].tolist() != [VERSION]:
        raise ResidualError(
            f"{path}: the file has version {kept['version'].tolist()}, this program reads version {VERSION}; {_AGAIN}"
        )
    arrays = {name: kept[name] for name in _ARRAYS}
    if str(kept["check"]) != _check(arrays):
        raise ResidualError(f"{path}: the file is damaged (checksum); {_AGAIN}")
    if str(kept["survey"]) != digest(survey):
        raise ResidualError(f"{path}: the residual map belongs to another survey than the one beside it; {_AGAIN}")
    grid, mean, sigma = (np.ascontiguousarray(arrays[name], dtype=np.float64) for name in ("grid", "mean", "sigma"))
    return ResidualMap(tuple(arrays["lamp_ids"].tolist()), grid, mean, sigma, float(arrays["noise"][0]))


_AGAIN: Final = "delete it, or calibrate again"


def digest(survey: Survey) -> str:
    """Digest of a survey's values, without comments and layout."""
    return hashlib.sha256(dump(survey).encode()).hexdigest()


def _check(arrays: dict[str, np.ndarray]) -> str:
    total = hashlib.sha256()
    for name in _ARRAYS:
        array = np.ascontiguousarray(arrays[name])
        total.update(f"{name} {array.dtype.str} {array.shape}".encode())
        total.update(array.tobytes())
    return total.hexdigest()
