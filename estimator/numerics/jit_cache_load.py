"""Loads compiled kernels from the disk without numba's preparations for compiling.

Before numba searches its cache it prepares to compile: it imports a hundred of its modules and fills its type tables.
With the machine code of a kernel it also reads the bitcode, for inlining into kernels yet to be compiled. A start that
compiles nothing needs neither: that is two thirds of the loading time of the kernels, and 30 MB. So only the machine
code is loaded; bitcode is parsed on first use. numba also compiles its reference counting, to be inlined into kernels.
Cached kernels already contain it and need only the addresses of the functions it calls. That is a third of the rest,
and LLVM's compiler is not used at all.

Most of this relies on private parts of numba. With a version that lacks them, numba's own cache is used.
"""

from __future__ import annotations

import sys
from functools import cache
from typing import Any, Final

import llvmlite.binding
from numba.core import codegen
from numba.core.compiler_lock import global_compiler_lock

_upstream: Any = codegen  # untyped
_runtime: Any = sys.modules.get("numba.core.runtime._nrt_python")
_WRAPPER: Final = "_ZN7cpython"
"""Prefix of the names of functions that Python calls (`numba.core.itanium_mangler`)."""


class _Kept(_upstream.JITCodeLibrary):  # type: ignore[misc]  # untyped upstream
    """Machine code with its bitcode unparsed until another kernel inlines it."""

    _bitcode = b""
    _read: Any = None

    @classmethod
    def _unserialize(cls, owner: Any, state: Any) -> Any:
        """Load machine code from the cache, and keep the bitcode as bytes."""
        name, kind, data = state
        if kind != "object":
            return super()._unserialize(owner, state)
        library = owner.create_library(name)
        machine_code, library._bitcode = data
        library.enable_object_caching()
        library._set_compiled_object(machine_code)
        library._finalize_final_module()
        return library

    @property
    def _shared_module(self) -> Any:
        """Module parsed from the bitcode on first use."""
        if self._bitcode:
            self._read, self._bitcode = llvmlite.binding.parse_bitcode(self._bitcode), b""
            self._codegen._engine._load_defined_symbols(self._read)
        return self._read

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self._read = module

    def get_pointer_to_function(self, name: str) -> int:
        """Address of a function; a Python wrapper is found without the bitcode."""
        if self._bitcode and name.startswith(_WRAPPER):  # is present; other names are in the unparsed bitcode
            self._codegen._engine._defined_symbols.add(name)
        return int(super().get_pointer_to_function(name))


_parts: Final = ("_unserialize", "_finalize_final_module", "_set_compiled_object", "get_pointer_to_function")
_known: Final = (
    getattr(_upstream.JITCPUCodegen, "_library_class", None) is _upstream.JITCodeLibrary
    and all(hasattr(_upstream.JITCodeLibrary, part) for part in _parts)
    and hasattr(_runtime, "c_helpers")
)


@cache
def _name_helpers() -> None:
    """Register with LLVM the C functions for memory management, under the names that machine code uses.

    numba's `_Runtime.initialize` does the same, and the rest, before anything is compiled.
    """
    for name, address in _runtime.c_helpers.items():
        llvmlite.binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def loaded(compiled: Any, signature: str) -> bool:
    """Load the cached machine code of this signature into a `numba.njit` function.

    As `Dispatcher.compile` does on a cache hit, without ``refresh()`` of the type tables. Returns False if nothing is
    cached or if this version of numba does not allow it.
    """
    if not _known or not hasattr(compiled._cache, "_load_overload"):
        return False
    with global_compiler_lock:
        context = compiled.targetctx
        _name_helpers()
        maker = context.codegen()
        maker._library_class = _Kept  # on this one object, and only while the kernel is loaded
        try:
            kept = compiled._cache._load_overload(signature, context)
        finally:
            del maker._library_class
        if kept is None:
            return False
        context.insert_user_function(kept.entry_point, kept.fndesc, [kept.library])
        compiled.add_overload(kept)
        return True
