"""Standard streams that the caller has closed: opened on /dev/null.

Otherwise the next file or device that is opened receives the number 0, 1 or 2, and with it what libraries print.
"""

from __future__ import annotations

import os
import sys
from typing import Final

NAMES: Final = ("stdin", "stdout", "stderr")


def open_closed_streams() -> None:
    """Open each closed standard stream on /dev/null, for this process and its children."""
    for number, name in enumerate(NAMES):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest free number, which is this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "w" if number else "r", closefd=False))
