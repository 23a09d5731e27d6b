"""The one way to make a numba function here, and the one place where its compiled form is kept.

Every hot function is written as a plain Python function and decorated with :func:`kernel`:

* an explicit signature: it compiles when imported, never inside a cycle, and a wrong dtype is a ``TypeError``; those
  that only kernels call (``inner``) are in their callers' machine code, and a start does without their own;
* with the interpreter held, but where ``aside`` says otherwise: letting it go and taking it back costs as much as the
  arithmetic of a small kernel, and while a background job runs Python, whoever has let go waits for it every time;
* NaN-safe fast math: ``nnan`` and ``ninf`` are left out, because they fold ``isnan`` to False;
* ``error_model="numpy"``: division by zero yields inf, as in the slow twin;
* cached on disk under a directory named by a hash of *all* kernel sources and of the compiler's versions. numba's own
  key does not cover callees in other files, so an edited callee would leave a stale caller behind, nor the flags that
  come from the environment: a run with ``NUMBA_BOUNDSCHECK=1`` (every index is checked, `IndexError`) or
  ``NUMBA_CPU_NAME=generic`` (no instructions beyond the architecture's first) has a directory of its own.

This is the only module of the room that touches the file system; it does so once, when first imported.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar

import llvmlite.binding
import numpy as np

# Importing numba asks whether scipy's BLAS is there, which loads a large part of scipy: a third of a warm start and
# 17 MB. No kernel uses BLAS. None makes that one import fail, which numba takes for an answer.
_BLAS: Final = "scipy.linalg.cython_blas"
_hide = _BLAS not in sys.modules
if _hide:
    sys.modules[_BLAS] = None  # type: ignore[assignment]  # the documented way to block an import
try:
    import numba
    import numba.np.arraymath  # the module that asks
    from numba.core import config
finally:
    if _hide:
        del sys.modules[_BLAS]

_numba_config: Any = config  # untyped upstream; read by numba each time a function is decorated

P = ParamSpec("P")
R = TypeVar("R")

FASTMATH: Final = {"contract", "reassoc", "arcp", "nsz"}
KEPT: Final = 4
"""Directories of other sources that are kept beside our own, the latest used ones."""
KEPT_S: Final = 7 * 86400.0
"""And all that were used more recently than this: their programs may be running..."""
MOST: Final = 40
"""...but no more than these in all, some 10 MB each. A running program has its kernels in memory and misses nothing."""

SHAPING: Final = (
    "BOUNDSCHECK",
    "CPU_NAME",
    "CPU_FEATURES",
    "ENABLE_AVX",
    "OPT",
    "LOOP_VECTORIZE",
    "SLP_VECTORIZE",
    "DEBUGINFO_DEFAULT",
)
"""numba's settings (environment variables, without their prefix ``NUMBA_``) that shape the machine code."""


def source_key() -> str:
    """Hash of every source file of this room and of the versions and settings that turn it into machine code."""
    digest = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(path.name.encode())
        digest.update(path.read_bytes())
    versions = (sys.version_info[:2], numba.__version__, llvmlite.__version__, np.__version__)
    digest.update(repr(versions).encode())
    digest.update(repr([str(getattr(_numba_config, name, None)) for name in SHAPING]).encode())
    return digest.hexdigest()[:16]


def _writable(directory: Path) -> bool:
    """Whether a file can be made there: numba ignores a cache directory it cannot create a file in, silently."""
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=directory):
            return True
    except OSError:
        return False


def _cache_roots() -> list[Path]:
    """Candidates in order: explicit, the service manager's CacheDirectory, the user's cache, a temporary directory."""
    env = os.environ
    named = [env[name] for name in ("NUMBA_CACHE_DIR", "CACHE_DIRECTORY") if env.get(name)]
    home = env.get("XDG_CACHE_HOME") or (str(Path(env["HOME"]) / ".cache") if env.get("HOME") else "")
    roots = [Path(name) for name in named]
    if home:
        roots.append(Path(home) / "lumiloop")
    roots.append(Path(tempfile.gettempdir()) / f"lumiloop-{os.getuid()}")
    return roots


def _last_used(directory: Path) -> float:
    try:
        return directory.stat().st_mtime
    except OSError:  # another process has removed it just now
        return 0.0


def _prune(root: Path, ours: Path) -> None:
    """Remove what earlier versions left behind; whatever cannot be removed stays."""
    now = _last_used(ours)
    others = sorted((path for path in root.glob("kernels-*") if path != ours), key=_last_used, reverse=True)
    for rank, path in enumerate(others):
        if rank >= MOST or (rank >= KEPT and now - _last_used(path) > KEPT_S):
            shutil.rmtree(path, ignore_errors=True)


def _choose_cache() -> Path:
    key = source_key()
    for root in _cache_roots():
        directory = root / f"kernels-{key}"
        is_new = not directory.exists()
        if _writable(directory):
            os.utime(directory)  # when it was last used
            if is_new:
                _prune(root, directory)
            return directory
    raise RuntimeError("no writable directory for compiled kernels; set NUMBA_CACHE_DIR to one")


CACHE_DIR: Final = _choose_cache()
"""Where compiled kernels of exactly these sources live."""

_numba_config.CACHE_DIR = str(CACHE_DIR)


def kernel(
    signature: str, inline: bool = False, aside: bool = False, inner: bool = False
) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Compile a function for one explicit signature (numba's string notation, e.g. ``"f8(f8[::1], i8)"``).

    ``inline`` writes its body into the kernels that call it: handing over three arrays costs as much as ten points.
    ``inner`` says that kernels alone call it, as they alone call those with ``inline``.
    ``aside`` lets other threads run Python meanwhile: for what takes longer than some 50 us in background jobs.

    The plain Python function stays reachable as ``.py_func`` for the slow-twin tests and for coverage. With
    ``NUMBA_DISABLE_JIT=1`` nothing is compiled and every kernel is its own ``.py_func``.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        compiled: Any = numba.njit(
            nogil=aside,
            cache=True,
            fastmath=FASTMATH,
            error_model="numpy",
            boundscheck=None,
            inline="always" if inline else "never",
        )(function)
        if _numba_config.DISABLE_JIT:
            compiled.py_func = function
        elif inner or inline:
            _compile_on_use(compiled, signature)
        else:
            _compile(compiled, signature)
        return compiled  # type: ignore[no-any-return]  # numba has no types

    return decorate


def _compile(compiled: Any, signature: str) -> None:
    """For this signature, and for no other ever: what `numba.njit` does that is given one."""
    compiled.compile(signature)
    compiled.disable_compile()


def _compile_on_use(compiled: Any, signature: str) -> None:
    """As late as a kernel that calls it is compiled, or a test calls it."""
    of_callers, of_calls = compiled.get_call_template, compiled._compile_for_args

    def now() -> None:
        compiled.get_call_template, compiled._compile_for_args = of_callers, of_calls
        _compile(compiled, signature)

    def get_call_template(args: Any, kws: Any) -> Any:
        now()
        return of_callers(args, kws)

    def compile_for_args(*args: Any, **kws: Any) -> Any:
        now()
        return compiled  # whoever asks calls what it gets

    compiled.get_call_template, compiled._compile_for_args = get_call_template, compile_for_args


def _announce_no_calls() -> None:
    """To numba's listeners, of which there are none: a start makes 20 000 calls of LLVM, and spends a sixth on that."""
    with contextlib.suppress(AttributeError):  # private upstream
        llvmlite.binding.ffi.lib._lock._cblist.clear()


_announce_no_calls()
