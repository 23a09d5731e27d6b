"""Libraries that only some commands need: how to have them."""

from __future__ import annotations

import sys
from importlib.util import find_spec


def how_to_install(extra: str) -> str:
    """The command that adds an ``extra`` to this installation; one as a service has no pip of its own."""
    pip = "pip" if find_spec("pip") else f"python3 -m pip --python {sys.executable}"
    return f"{pip} install 'lumiloop[{extra}]'"
