"""Kernels and decoder as compiled for 64-bit ARM, run under qemu's user emulation: the same numbers as here?

``python -m tools.bench.system.aarch64`` takes Debian's Python for arm64 (mmdebstrap, unpacked only: nothing of it is
installed), the wheels at the versions that this environment has, and lets ``tests.estimator.target_poses`` make its
drives there: scan matching with each matcher, fusion under lamps, lines, cells, and a decoded block of samples. It says
nothing about speed: an emulator is some thirty times slower than the processor it stands for.

Needed: ``apt-get install qemu-user-static mmdebstrap``, root or user namespaces, a network the first time. What was
fetched stays in ~/.cache/lumiloop-aarch64 (600 MB); removing it is all there is to clean up.
"""

import argparse
import importlib.metadata
import json
import os
import shutil
import subprocess
import sys
import time
import zipfile
from pathlib import Path
from typing import Final

import numpy as np

from tools.ci.figures import Figure, bounded, save, table

ROOT: Final = Path(__file__).parents[3]
COMMAND: Final = "python -m tools.bench.system.aarch64"
EMULATOR: Final = "qemu-aarch64-static"
TOOLS: Final = {EMULATOR: "qemu-user-static", "mmdebstrap": "mmdebstrap"}
DEBIAN: Final = "bookworm"
PYTHON: Final = "3.11"
PACKAGES: Final = f"python{PYTHON}-minimal,libpython{PYTHON}-stdlib,libstdc++6"
WHEELS: Final = (
    "numpy",
    "numba",
    "llvmlite",
    "scipy",
    "msgspec",
    "pytest",
    "pluggy",
    "iniconfig",
    "packaging",
    "pygments",
)
PLATFORMS: Final = ("manylinux2014", "manylinux_2_17", "manylinux_2_27", "manylinux_2_28")
TOLERANCE: Final = 1e-9
"""m, rad, uA; as of the tests for other processors of this architecture."""


class Missing(Exception):
    """Something that is needed is not there; the text says what and how to get it."""


def run(cache: Path) -> list[Figure]:
    """Fetch what is missing, run both, compare.

    Raises:
        Missing: a tool, a package or a wheel. RuntimeError: one of the two runs failed.
    """
    for tool, package in TOOLS.items():
        if shutil.which(tool) is None:
            raise Missing(f"{tool} is not installed: apt-get install {package}")
    root, site = debian(cache), wheels(cache)
    begin = time.monotonic()
    here = made([sys.executable], {})
    middle = time.monotonic()
    emulated = [EMULATOR, "-L", str(root), str(root / f"usr/bin/python{PYTHON}")]
    home = cache / "home"
    home.mkdir(exist_ok=True)
    there = made(
        emulated,
        {
            "HOME": str(home),
            "XDG_CACHE_HOME": str(home),
            "PYTHONPATH": f"{ROOT}:{site}",
            "PYTHONDONTWRITEBYTECODE": "1",
        },
    )
    rows = compared(here, there)
    rows.append(Figure("took here, kernels from the cache or not", middle - begin, "s", command=COMMAND))
    rows.append(Figure("took emulated", time.monotonic() - middle, "s", command=COMMAND))
    return rows


def debian(cache: Path) -> Path:
    """A folder with Debian's Python for arm64."""
    root = cache / DEBIAN
    if not (root / f"usr/bin/python{PYTHON}").exists():
        shutil.rmtree(root, ignore_errors=True)
        fetched("mmdebstrap", "--variant=extract", "--architectures=arm64", f"--include={PACKAGES}", DEBIAN, str(root))
    return root


def wheels(cache: Path) -> Path:
    """A folder with the packages for arm64, at this environment's versions."""
    wanted = [f"{name}=={importlib.metadata.version(name)}" for name in WHEELS]
    site, said = cache / "site", cache / "site.txt"
    if not said.exists() or said.read_text().split() != wanted:
        shutil.rmtree(site, ignore_errors=True)
        platforms = [word for name in PLATFORMS for word in ("--platform", f"{name}_aarch64")]
        words = ["-m", "pip", "download", "--quiet", "--no-deps", "--only-binary", ":all:", *platforms]
        into = cache / "wheels"
        shutil.rmtree(into, ignore_errors=True)
        fetched(sys.executable, *words, "--python-version", PYTHON, "-d", str(into), *wanted)
        for wheel in into.glob("*.whl"):
            zipfile.ZipFile(wheel).extractall(site)
        said.write_text("\n".join(wanted))
    return site


def fetched(*words: str) -> None:
    """Run a command that fetches something."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise Missing(f"`{' '.join(words)[:200]}` failed; is there a network? {done.stderr.strip()[-500:]}")


def made(interpreter: list[str], environment: dict[str, str]) -> dict[str, list[float]]:
    """The figures that an interpreter makes."""
    words = [*interpreter, "-m", "tests.estimator.target_poses"]
    done = subprocess.run(words, cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"`{' '.join(words)}` failed: {done.stderr.strip()[-2000:]}")
    content: dict[str, list[float]] = json.loads(done.stdout)["figures"]
    return content


def compared(here: dict[str, list[float]], there: dict[str, list[float]]) -> list[Figure]:
    """The largest difference of each kind of number.

    Raises:
        RuntimeError: there are other numbers, or fewer.
    """
    if {name: len(one) for name, one in here.items()} != {name: len(one) for name, one in there.items()}:
        raise RuntimeError(f"other numbers: here {sorted(here)}, emulated {sorted(there)}")
    rows = []
    for name, values in here.items():
        off = float(np.max(np.abs(np.subtract(there[name], values)), initial=0.0))
        rows.append(
            bounded(f"{name} ({len(values)} numbers), largest difference", off, "", f"<= {TOLERANCE:g}", COMMAND)
        )
    return rows


def main() -> int:
    """The command."""
    parser = argparse.ArgumentParser(prog=COMMAND, description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--cache", type=Path, default=Path.home() / ".cache" / "lumiloop-aarch64")
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    options.cache.mkdir(parents=True, exist_ok=True)
    try:
        rows = run(options.cache)
    except (Missing, RuntimeError) as error:
        print(error, file=sys.stderr)
        return 2
    print(table(rows))
    print(f"written: {save('aarch64', rows, options.out)}")
    return int(any(row.ok is False for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
