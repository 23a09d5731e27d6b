"""Standard streams that are closed receive nothing that is opened later."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]
CODE = """
import os, sys
from pathlib import Path
from daemon import __main__
from daemon.system.logging import start_log
sys.argv = ["lumiloop", "--schema"]
assert __main__.main() == 0
start_log()
print("to stderr", file=sys.stderr, flush=True)
Path(os.environ["FOUND"]).write_text(str(os.open(os.devnull, os.O_RDONLY)))
"""


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_closed_standard_streams_receive_nothing_that_is_opened(tmp_path: Path, closed: str) -> None:
    found = tmp_path / "found"
    words = ["sh", "-c", f'exec "$0" -c "$1" {closed}', sys.executable, CODE]
    done = subprocess.run(words, cwd=ROOT, env={"FOUND": str(found)}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert int(found.read_text()) > 2
    assert done.stderr == ("" if "2>&-" in closed else "to stderr\n")
