"""What the Makefile promises of all its targets."""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_no_two_targets_run_at_once(tmp_path: Path) -> None:
    """Suites judge against the wall clock, and share ports and the folder ``out``."""
    path = tmp_path / "Makefile"
    path.write_text(f"include {ROOT}/Makefile\none two:\n\t@echo begin $@; sleep 0.2; echo end $@\n")
    command = ["make", "-s", "-j4", "-f", str(path), "one", "two"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert done.stdout.splitlines() == ["begin one", "end one", "begin two", "end two"]
