"""Entry point of ``python -m daemon``, which is the same as the ``lumiloop`` command."""

from __future__ import annotations

import signal
import sys

from daemon.system.memory_limit import REMEDY, lacks_memory
from daemon.system.standard_streams import open_closed_streams


def main() -> int:
    """Run one command and return its exit code. Ctrl-C during the import of its modules ends the process silently."""
    open_closed_streams()
    try:
        return _command()
    except (MemoryError, ImportError) as error:
        if not lacks_memory(error):
            raise
        sys.stderr.write(f"lumiloop: not enough memory for this command; {REMEDY}\n")
        return 1


def _command() -> int:
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # an ignored SIGINT stays ignored
    if raises:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from daemon.cli.parser import main as command

    if raises:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return command()


if __name__ == "__main__":
    sys.exit(main())
