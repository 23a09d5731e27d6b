"""Which share of a large set of tests runs with this commit; all of them run with the slow ones (``make test-all``)."""

import subprocess
from functools import cache
from pathlib import Path

import pytest


@cache
def turn(of: int) -> int:
    """A number below ``of``, by the commit; 0 where there is none."""
    root = Path(__file__).parent
    asked = subprocess.run(["git", "rev-parse", "HEAD"], cwd=root, capture_output=True, text=True, check=False)
    return int(asked.stdout.strip() or "0", 16) % of


def share(number: int, of: int) -> list[pytest.MarkDecorator]:
    """Marks of one of a set of tests, of which each commit plays those whose ``number`` has its turn, modulo ``of``."""
    return [] if number % of == turn(of) else [pytest.mark.slow]
