"""Everything that takes bytes from outside, one module each, all of the same shape.

``MEGABYTES``: of a full run. ``seeds()``: well-formed inputs. ``mend(data)``:
sums made right again, so that damage reaches what lies behind them. ``feeder()``: what takes one input; it raises where
anything but the parser's own refusal comes out, and where sound bytes after it are not understood.
"""

import atexit
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

NAMES = ("scip", "adc", "bus", "modbus", "udp", "stream", "toml", "map", "log")


def a_file(name: str) -> Path:
    """Where an input can be written, in a folder of its own."""
    folder = Path(tempfile.mkdtemp(prefix="lumiloop-fuzz-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder / name


def refused(call: Callable[..., Any], *arguments: object, by: type[Exception] | tuple[type[Exception], ...]) -> str:
    """What the refusal of a call says, by an exception of these kinds; empty: it was not refused."""
    try:
        call(*arguments)
    except by as error:
        return str(error) or repr(error)
    return ""
