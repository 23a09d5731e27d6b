"""Commands ``help``, ``completion`` and ``man``, and their bodies."""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Final

from daemon.cli.command_body import Body
from daemon.cli.manual.catalogue import GROUPS
from daemon.cli.manual.command_parser import near, subcommands, summaries
from daemon.system.console import OK, USAGE, fail

Commands = argparse._SubParsersAction  # what add_subparsers() gives; argparse has no public name for it
SHELLS: Final = ("bash", "zsh", "fish")


def add(commands: Commands[argparse.ArgumentParser], root: argparse.ArgumentParser, version: Callable[[], str]) -> None:
    """Adds the commands; ``root``: the parser that they describe."""
    helped = commands.add_parser("help", help="print options and examples of a command")
    helped.add_argument("words", nargs="*", metavar="COMMAND", help="for example: map import, or all")
    helped.set_defaults(body=_help(root))
    completion = commands.add_parser("completion", help="print a completion script for a shell")
    completion.add_argument("shell", choices=SHELLS, metavar="SHELL", help="bash, zsh or fish")
    completion.set_defaults(body=_completion(root))
    man = commands.add_parser("man", help="print a man page, or write all of them")
    man.add_argument("words", nargs="?", metavar="COMMAND", help="default: the page of the program")
    man.add_argument("--out", type=Path, metavar="DIR", help="write a page for every command into this folder")
    man.set_defaults(body=_man(root, version))


def _help(root: argparse.ArgumentParser) -> Body:
    def body(args: argparse.Namespace) -> int:
        if args.words == ["all"]:
            sys.stdout.write(listing(root))
            return OK
        found = root
        for word in args.words:
            below = subcommands(found)
            if word not in below:
                hint = near(word, list(below)) or "`lumiloop help all` lists them"
                return fail(f"no such command: {word!r}; {hint}", USAGE)
            found = below[word]
        sys.stdout.write(found.format_help())
        return OK

    return body


def listing(root: argparse.ArgumentParser) -> str:
    """Every command with one line, by group."""
    known = summaries(root)
    lines: list[str] = []
    for group in GROUPS:
        lines += [f"{group.title}: {group.text}", *(f"  {name:<13}{known[name]}" for name in group.commands), ""]
    return "\n".join(lines[:-1]) + "\n"


def _completion(root: argparse.ArgumentParser) -> Body:
    def body(args: argparse.Namespace) -> int:
        from daemon.cli.manual.completion import script

        sys.stdout.write(script(args.shell, root))
        return OK

    return body


def _man(root: argparse.ArgumentParser, version: Callable[[], str]) -> Body:
    def body(args: argparse.Namespace) -> int:
        from daemon.cli.manual.man_pages import pages

        number = re.search(r"\d+\.\S+", version())
        made = pages(root, f"lumiloop {number[0]}" if number else "lumiloop")
        name = f"lumiloop-{args.words}.1" if args.words else "lumiloop.1"
        if name not in made:
            return fail(f"no such command: {args.words!r}; `lumiloop help all` lists the commands", USAGE)
        if args.out is None:
            sys.stdout.write(made[name])
            return OK
        try:
            args.out.mkdir(parents=True, exist_ok=True)
            for file, text in made.items():
                (args.out / file).write_text(text)
        except OSError as error:
            return fail(f"{args.out}: cannot write the page: {error.strerror}")
        sys.stdout.write(f"{len(made)} pages written to {args.out}\n")
        return OK

    return body
