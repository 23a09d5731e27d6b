"""Lazy exports of a package (PEP 562): the module of a name is loaded when the name is first used."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def exports_of(
    package: str, names_of: Mapping[str, str]
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of ``package``.

    Args:
        package: its full name.
        names_of: by module, without the package's name, the names it exports, separated by blanks. Modules that are
            exported themselves stand under the key "".
    """
    module_of = {
        name.rpartition(".")[2]: (module, name) for module, names in names_of.items() for name in names.split()
    }

    def package_getattr(name: str) -> object:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, path = module_of[name]
        found = getattr(import_module(f"{package}.{module}"), name) if module else import_module(f"{package}.{path}")
        vars(sys.modules[package])[name] = found  # the next look-up finds it without this function
        return found

    exported = sorted(module_of)
    return package_getattr, lambda: exported, exported
