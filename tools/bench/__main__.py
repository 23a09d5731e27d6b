"""``python -m tools.bench [name ...]``: run the benchmarks, print their tables, write ``out/bench/<name>.json``.

A benchmark is a module of this package with ``run() -> list[Figure]``. Times are compared with a peer in the same run,
because this kind of machine is shared and noisy; a missed target is printed, never turned into a failed test.
"""

import argparse
import importlib
import pkgutil
import signal
import sys
from pathlib import Path

import tools.bench.system
from tools.ci.figures import save, table


def modules() -> dict[str, str]:
    """Benchmarks that exist: name to module."""
    folders = {"tools.bench.": tools.bench.__path__, "tools.bench.system.": tools.bench.system.__path__}
    found = [m for prefix, path in folders.items() for m in pkgutil.iter_modules(path, prefix) if not m.ispkg]
    return {m.name.rpartition(".")[2]: m.name for m in found if not m.name.endswith("__main__")}


def names() -> list[str]:
    """Names of benchmarks, sorted."""
    return sorted(modules())


def reason(error: Exception) -> str:
    """An error as text: what our own messages say, and the kind of any other, which its text alone may not tell."""
    return (
        str(error) if isinstance(error, (OSError, RuntimeError)) and str(error) else f"{type(error).__name__}: {error}"
    )


def main() -> int:
    """Run what was asked for; exit status 1 when a benchmark could not run at all."""
    parser = argparse.ArgumentParser(prog="python -m tools.bench", description=__doc__)
    parser.add_argument("name", nargs="*", help=f"which ones (default: all of {', '.join(names())})")
    parser.add_argument("--out", type=Path, default=Path("out/bench"))
    options = parser.parse_args()
    unknown = set(options.name) - set(names())
    if unknown:
        parser.error(f"no such benchmark: {', '.join(sorted(unknown))}; there are {', '.join(names())}")
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # what a benchmark has started must not outlive it
    failed = False
    for name in options.name or names():
        print(f"\n== {name}", flush=True)
        try:
            figures = importlib.import_module(modules()[name]).run()
        except Exception as error:  # noqa: BLE001  one broken benchmark must not hide the others' figures
            print(f"{name} could not run: {reason(error)}")
            failed = True
            continue
        print(table(figures))
        print(f"written: {save(name, figures, options.out)}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
