"""Argument parser of `lumiloop`: grouped help on one screen, examples, and suggestions for misspelt words."""

from __future__ import annotations

import argparse
import difflib
from collections.abc import Iterator, Sequence
from typing import Any, Final, NoReturn

from daemon.cli.manual.catalogue import EXAMPLES, GROUPS

LEVELS: Final = ("debug", "info", "warning", "error")
NEAR: Final = 0.6
"""Similarity from which a word is suggested."""


class CommandParser(argparse.ArgumentParser):
    """Parser that suggests the nearest word for one that it does not know. Its subcommands are of the same class."""

    def __init__(self, **words: Any) -> None:
        words.setdefault("formatter_class", argparse.RawDescriptionHelpFormatter)
        super().__init__(**words)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """argparse: refuse a value that is none of an action's choices."""
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            hint = near(str(value), choices)
            listed = "`lumiloop help all` lists them" if action.dest == "command" else f"name {', '.join(choices)}"
            raise argparse.ArgumentError(action, f"{str(value)!r} is unknown; {hint or listed}")

    def error(self, message: str) -> NoReturn:
        """argparse: end with exit code 2, and say where help is."""
        command = self.prog.partition(" ")[2]
        self.exit(2, f"{self.prog}: error: {message}\nfor help: lumiloop help{command and f' {command}'}\n")

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]  # argparse overloads it
        """As argparse; an unknown option is reported with the nearest one of its command."""
        found, more = self.parse_known_args(args, namespace)
        if more:
            self._refuse(more, getattr(found, "parser", self))
        return found

    def _refuse(self, more: Sequence[str], used: argparse.ArgumentParser) -> NoReturn:
        options = [word for action in used._actions for word in action.option_strings]
        word = more[0].partition("=")[0]
        hint = near(word, options) if word.startswith("-") else ""
        used.error("; ".join(filter(None, (f"unknown: {more[0]!r}", hint))))


def near(word: str, words: Sequence[str]) -> str:
    """A question for the words nearest to one; empty where none is near."""
    found = difflib.get_close_matches(word, words, n=2, cutoff=NEAR)
    return f"did you mean {' or '.join(found)}?" if found else ""


def subcommands(parser: argparse.ArgumentParser) -> dict[str, argparse.ArgumentParser]:
    """The commands of a parser, or the verbs of a command, by name; empty where it has none."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return dict(action.choices)
    return {}


def summaries(parser: argparse.ArgumentParser) -> dict[str, str]:
    """One line for each command or verb."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            return {choice.dest: choice.help or "" for choice in action._choices_actions}
    return {}


def every(parser: argparse.ArgumentParser, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command and verb below a parser, with the words that name it."""
    for name, below in subcommands(parser).items():
        yield (*words, name), below
        yield from every(below, (*words, name))


def finish(parser: argparse.ArgumentParser) -> None:
    """Complete the parsers of all commands: description, examples, and the options that each has."""
    lines = summaries(parser)
    output_options(parser)
    for words, command in every(parser):
        if len(words) == 1:
            command.description = command.description or f"{lines[words[0]][:1].upper()}{lines[words[0]][1:]}."
            command.epilog = examples(words[0])
        command.set_defaults(parser=command)
        output_options(command)


def output_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that every command has. Absent ones stay unset: they may stand before the command, too."""
    group = parser.add_argument_group("output")
    absent = argparse.SUPPRESS
    group.add_argument("-v", "--verbose", action="store_const", const="debug", dest="log_level", default=absent,
                       help="log details too")  # fmt: skip
    group.add_argument("-q", "--quiet", action="store_const", const="error", dest="log_level", default=absent,
                       help="print errors and results only")  # fmt: skip
    group.add_argument("--log-level", choices=LEVELS, default=absent, help="what to log; default: info")


def examples(command: str) -> str:
    """Text with the examples of a command."""
    rows = EXAMPLES.get(command, ())
    return "\n".join(["examples:", *(f"  lumiloop {line}\n      {text}" for line, text in rows)]) if rows else ""


def overview(description: str) -> str:
    """Help of the program on one screen of 80 x 24."""
    lines = ["usage: lumiloop [--version | -v | -q] COMMAND [OPTIONS]", "", *description.splitlines(), ""]
    for group in GROUPS:
        lines += [f"{group.title + ':':<9}{group.text}", f"{'':<11}{'  '.join(group.commands)}"]
    lines += ["", "lumiloop help COMMAND: options and examples. lumiloop help all: all commands."]
    return "\n".join(lines) + "\n"
