"""Optional dependencies of some commands: how to install them."""

from __future__ import annotations

import sys
from importlib.util import find_spec


def how_to_install(extra: str) -> str:
    """Command line that adds the optional dependencies ``extra`` to this installation.

    A service installation has no pip of its own.
    """
    pip = "pip" if find_spec("pip") else f"python3 -m pip --python {sys.executable}"
    return f"{pip} install 'lumiloop[{extra}]'"
