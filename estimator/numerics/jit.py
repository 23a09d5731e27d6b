"""The one way to make a numba function here.

Every hot function is written as a plain Python function and decorated with :func:`kernel`:

* an explicit signature: it compiles when imported, never inside a cycle, and a wrong dtype is a ``TypeError``; those
  that only kernels call (``inner``) are in their callers' machine code, and a start does without their own;
* with the interpreter held, but where ``aside`` says otherwise: letting it go and taking it back costs as much as the
  arithmetic of a small kernel, and while a background job runs Python, whoever has let go waits for it every time;
* NaN-safe fast math: ``nnan`` and ``ninf`` are left out, because they fold ``isnan`` to False;
* ``error_model="numpy"``: division by zero yields inf, as in the slow twin;
* cached on disk, in the directory of `jit_cache`, and taken from there by `jit_cache_load`.
"""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, ParamSpec, TypeVar

import llvmlite.binding
import numba
from numba.core import config

from estimator.numerics.jit_cache import CACHE_DIR
from estimator.numerics.jit_cache_load import loaded

_BLAS: Final = "scipy.linalg.cython_blas"

_numba_config: Any = config  # untyped upstream; read by numba each time a function is decorated

P = ParamSpec("P")
R = TypeVar("R")

FASTMATH: Final = {"contract", "reassoc", "arcp", "nsz"}

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
    if not loaded(compiled, signature):
        _get_ready()
        compiled.compile(signature)
    compiled.disable_compile()


def _get_ready() -> None:
    """Import the module of numba's that asks whether scipy's BLAS is there; it is told that there is none.

    A large part of scipy would be loaded with it, 17 MB, and no kernel uses BLAS. None makes that one import fail,
    which numba takes for an answer.
    """
    hide = _BLAS not in sys.modules
    if hide:
        sys.modules[_BLAS] = None  # type: ignore[assignment]  # the documented way to block an import
    try:
        import_module("numba.np.arraymath")
    finally:
        if hide:
            del sys.modules[_BLAS]


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
