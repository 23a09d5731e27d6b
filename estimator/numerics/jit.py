"""The numba JIT decorator `kernel` of all hot functions.

Every hot function is a plain Python function with this decorator:

* explicit signature: it compiles at import, never inside a cycle, and a wrong dtype is a ``TypeError``.
  Kernels that only kernels call (``inner``) are part of their callers' machine code and are not loaded at a start.
* GIL held, unless ``aside``: releasing and taking it costs as much as the arithmetic of a small kernel.
  While a background job runs Python, each thread that released the GIL waits for it every time.
* NaN-safe fast math: without ``nnan`` and ``ninf``, because they fold ``isnan`` to False;
* ``error_model="numpy"``: division by zero yields inf, as in the slow twin;
* cached on disk, in the directory of `jit_cache`, in the files of `jit_cache_file`, and loaded by `jit_cache_load`.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from importlib import import_module
from typing import Any, Final, ParamSpec, TypeVar

import numba
from numba.core import config

from estimator.numerics.jit_cache import CACHE_DIR
from estimator.numerics.jit_cache_file import REPLACES_UPSTREAM, KernelCache
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

    The plain Python function stays reachable as ``.py_func`` for the slow-twin tests and for coverage. With
    ``NUMBA_DISABLE_JIT=1`` nothing is compiled and every kernel is its own ``.py_func``.

    Args:
        signature: types of the result and the arguments.
        inline: insert the body into the calling kernels: passing three arrays costs as much as ten points.
        aside: release the GIL: for background jobs that take longer than some 50 us.
        inner: only kernels call it, as with ``inline``.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        compiled: Any = numba.njit(
            nogil=aside,
            cache=not REPLACES_UPSTREAM,
            fastmath=FASTMATH,
            error_model="numpy",
            boundscheck=None,
            inline="always" if inline else "never",
        )(function)
        if _numba_config.DISABLE_JIT:
            compiled.py_func = function
            return compiled  # type: ignore[no-any-return]  # numba has no types
        if REPLACES_UPSTREAM:
            compiled._cache = KernelCache(function)
        if inner or inline:
            _compile_on_use(compiled, signature)
        else:
            _compile(compiled, signature)
        return compiled  # type: ignore[no-any-return]  # numba has no types

    return decorate


def _compile(compiled: Any, signature: str) -> None:
    """Load or compile this signature, and disable all others, as `numba.njit` with a signature does."""
    if not loaded(compiled, signature):
        _get_ready()
        compiled.compile(signature)
    compiled.disable_compile()


def _get_ready() -> None:
    """Import ``numba.np.arraymath`` without scipy's BLAS.

    That module tests whether scipy's BLAS is present, which would load a large part of scipy, 17 MB. No kernel uses
    BLAS. None in `sys.modules` makes that one import fail, which numba accepts as absence.
    """
    hide = _BLAS not in sys.modules
    if hide:
        sys.modules[_BLAS] = None  # type: ignore[assignment]  # documented method to block an import
    try:
        import_module("numba.np.arraymath")
    finally:
        if hide:
            del sys.modules[_BLAS]


def _compile_on_use(compiled: Any, signature: str) -> None:
    """Postpone compilation until a calling kernel is compiled or a test calls the function."""
    of_callers, of_calls = compiled.get_call_template, compiled._compile_for_args

    def now() -> None:
        compiled.get_call_template, compiled._compile_for_args = of_callers, of_calls
        _compile(compiled, signature)

    def get_call_template(args: Any, kws: Any) -> Any:
        now()
        return of_callers(args, kws)

    def compile_for_args(*args: Any, **kws: Any) -> Any:
        now()
        return compiled  # the caller calls the returned dispatcher

    compiled.get_call_template, compiled._compile_for_args = get_call_template, compile_for_args
