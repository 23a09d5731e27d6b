"""A kernel that has been compiled before is taken from the disk without what only compiling needs.

Before numba looks into its cache it gets ready to compile: it imports a hundred of its modules and fills its tables of
what every operation may be applied to; and with the machine code of a kernel it reads its bitcode, for those that will
be compiled with its body in them. A start where nothing is compiled needs neither: that is two thirds of what loading
the kernels takes, and 30 MB. So the machine code alone is loaded, and bitcode is read by the first who asks for it.
Last, numba compiles its counting of references, to be written into kernels: kept ones have it in them, and need no
more than the names of what it calls. That is a third of what is left, and no part of LLVM that compiles is touched.

Most of what is used here is private upstream. Where a version of numba has none of it, its own way is gone.
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
"""How the names of functions begin that Python calls (`numba.core.itanium_mangler`)."""


class _Kept(_upstream.JITCodeLibrary):  # type: ignore[misc]  # untyped upstream
    """Machine code, with the bitcode beside it unread until it is to be written into another kernel's."""

    _bitcode = b""
    _read: Any = None

    @classmethod
    def _unserialize(cls, owner: Any, state: Any) -> Any:
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
        if self._bitcode:
            self._read, self._bitcode = llvmlite.binding.parse_bitcode(self._bitcode), b""
            self._codegen._engine._load_defined_symbols(self._read)
        return self._read

    @_shared_module.setter
    def _shared_module(self, module: Any) -> None:
        self._read = module

    def get_pointer_to_function(self, name: str) -> int:
        if self._bitcode and name.startswith(_WRAPPER):  # it is there; other names are in what has not been read
            self._codegen._engine._defined_symbols.add(name)
        return int(super().get_pointer_to_function(name))


_parts: Final = ("_unserialize", "_finalize_final_module", "_set_compiled_object", "get_pointer_to_function")
_known: Final = (
    getattr(_upstream.JITCPUCodegen, "_library_class", None) is _upstream.JITCodeLibrary
    and all(hasattr(_upstream.JITCodeLibrary, part) for part in _parts)
    and hasattr(_runtime, "c_helpers")
)
if _known:
    _upstream.JITCPUCodegen._library_class = _Kept


@cache
def _name_helpers() -> None:
    """Tell LLVM the functions in C that manage memory, by the names that machine code calls them by.

    As numba's `_Runtime.initialize` does, which does it again, and the rest, before anything is compiled.
    """
    for name, address in _runtime.c_helpers.items():
        llvmlite.binding.add_symbol(name if name.startswith("_") else f"NRT_{name}", address)


def loaded(compiled: Any, signature: str) -> bool:
    """Give a `numba.njit` function the machine code that was kept for this signature; False: none was, or no such way.

    What `Dispatcher.compile` does where its cache has it, but for ``refresh()`` of the tables.
    """
    if not _known or not hasattr(compiled._cache, "_load_overload"):
        return False
    with global_compiler_lock:
        context = compiled.targetctx
        _name_helpers()
        kept = compiled._cache._load_overload(signature, context)
        if kept is None:
            return False
        context.insert_user_function(kept.entry_point, kept.fndesc, [kept.library])
        compiled.add_overload(kept)
        return True
