"""Bodies of ``lumiloop config init``, ``show`` and ``set``."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from daemon.config import discovery, loader
from daemon.system import console
from daemon.system.atomic_file import write_whole


def init(args: argparse.Namespace) -> int:
    """Writes the template to ``args.file``; returns the exit code."""
    file: Path = args.file
    try:
        if file.exists() and not args.force:
            raise loader.ConfigError(f"{file} exists already; name another file, or replace it with --force")
        write_whole(file, loader.template().encode())
    except loader.ConfigError as error:
        return console.fail(str(error))
    except OSError as error:
        return console.fail(f"cannot write {file}: {error.strerror}; name another file")
    sys.stdout.write(f"written: {file}\n")
    return console.OK


def show(args: argparse.Namespace) -> int:
    """Prints every value as TOML, below comments that say where it comes from; returns the exit code."""
    source = discovery.find(args.config)
    try:
        settings = loader.load(source.file, args.set)
    except loader.ConfigError as error:
        return console.fail(str(error), console.USAGE)
    head = [f"configuration: {source}"]
    if source.file is None:
        head += ["searched:", *(f"  {path} ({how})" for path, how in discovery.places())]
    head += [f"--set {override}" for override in args.set]
    sys.stdout.write("".join(f"# {line}\n" for line in head) + "\n" + loader.dump(settings))
    return console.OK


def change(args: argparse.Namespace) -> int:
    """Sets ``args.values`` in the configuration file; returns the exit code."""
    source = discovery.find(args.config)
    try:
        if source.file is None:
            raise loader.ConfigError("no configuration file was found; make one with `lumiloop config init`")
        values = dict(loader.parsed(text) for text in args.values)
        loader.write_back(source.file, values)
    except loader.ConfigError as error:
        return console.fail(str(error), console.USAGE)
    sys.stdout.write(f"written: {source.file}; a running daemon uses it after a restart\n")
    return console.OK
