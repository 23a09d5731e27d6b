"""``python -m daemon``: the same as the ``lumiloop`` command."""

from __future__ import annotations

import signal
import sys


def main() -> int:
    """Run one command; Ctrl-C while its modules are still being loaded ends it without a word."""
    raises = signal.getsignal(signal.SIGINT) is signal.default_int_handler  # else it is ignored, and stays so
    if raises:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from daemon.cli.parser import main as command

    if raises:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    return command()


if __name__ == "__main__":
    sys.exit(main())
