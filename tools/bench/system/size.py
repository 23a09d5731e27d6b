"""What an installation takes on the disk: the core as `make install` lays it down, and with every extra of a robot.

The extras are those of `pyproject.toml` that a robot runs; what draws, compares or tests stays on a desk. Versions are
those of `requirements/dev.lock`. Everything goes below a temporary folder; packages come from the index that pip has.
"""

import os
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

from tools.ci.figures import Figure, bounded

COMMAND = "python -m tools.bench size"
ROOT = Path(__file__).parents[3]
DESK = frozenset({"plot", "bench", "test"})
CORE_MB, ROBOT_MB = 480, 580


def extras() -> dict[str, list[str]]:
    """What each extra of a robot asks for."""
    told = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    return {name: wanted for name, wanted in told.items() if name not in DESK}


def size_mb(folder: Path) -> float:
    """Bytes of all files, in 1e6; what is linked is counted where it lies."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return 1e-6 * sum(path.lstat().st_size for path in files)


def locked(folder: Path) -> Path:
    """The versions of the lock file, as constraints: pip takes no hashes for a part of what is locked, nor extras."""
    lines = (ROOT / "requirements" / "dev.lock").read_text().splitlines()
    pins = [re.sub(r"\[.*?\]", "", line.removesuffix("\\").strip()) for line in lines if line[:1].isalnum()]
    path = folder / "constraints.txt"
    path.write_text("\n".join(pins) + "\n")
    return path


def add(tree: Path, wanted: list[str], constraints: Path) -> None:
    """Put what an extra asks for, and is not there yet, beside the rest, compiled as the rest is.

    Raises:
        RuntimeError: pip cannot; the text is its own.
    """
    (site,) = tree.glob("opt/lumiloop/lib/python3*/site-packages")
    interpreter = tree / "opt/lumiloop/bin/python"
    words = [sys.executable, "-m", "pip", "--python", interpreter, "install", "--quiet", "--no-compile"]
    words += ["--disable-pip-version-check", "-c", constraints, *wanted]
    done = subprocess.run(words, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr.strip())
    subprocess.run([sys.executable, "-m", "compileall", "-q", "-j", "0", site], check=False, capture_output=True)


def run() -> list[Figure]:
    """Install, and weigh.

    Raises:
        RuntimeError: the installation failed; the text is its own.
    """
    figures = []
    with tempfile.TemporaryDirectory(prefix="lumiloop-size-") as name:
        tree = Path(name) / "tree"
        done = subprocess.run(
            [ROOT / "systemd/install.sh", "install"],
            env={**os.environ, "DESTDIR": str(tree), "PYTHON": sys.executable}, capture_output=True, text=True,
        )  # fmt: skip
        if done.returncode:
            raise RuntimeError(done.stderr.strip())
        core = size_mb(tree)
        figures.append(bounded("installed, without extras", core, "MB", f"<= {CORE_MB}", COMMAND))
        constraints, before = locked(Path(name)), core
        for extra, wanted in extras().items():
            add(tree, wanted, constraints)
            now = size_mb(tree)
            figures.append(Figure(f"{extra} adds", now - before, "MB", command=COMMAND))
            before = now
        figures.append(bounded("installed, with all extras of a robot", before, "MB", f"<= {ROBOT_MB}", COMMAND))
    return figures
