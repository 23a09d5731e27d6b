"""Man pages (troff, man(7)) of the program and of every command, made from the parsers."""

from __future__ import annotations

import argparse
import re

from daemon.cli.manual.catalogue import EXAMPLES, GROUPS
from daemon.cli.manual.command_parser import subcommands, summaries

EXIT_CODES = (
    ("0", "done"),
    ("1", "failed or refused; the text gives cause and remedy"),
    ("2", "wrong usage or configuration"),
    ("130", "interrupted"),
)
FILES = (
    ("$LUMILOOP_CONFIG", "configuration file; only --config takes precedence"),
    ("./lumiloop.toml", "configuration file of the working directory"),
    ("$XDG_CONFIG_HOME/lumiloop/lumiloop.toml", "configuration file of the user"),
    ("/etc/lumiloop/lumiloop.toml", "configuration file of the system"),
)


def pages(parser: argparse.ArgumentParser, version: str) -> dict[str, str]:
    """File name and text of every page."""
    commands = subcommands(parser)
    named = {
        f"lumiloop-{name}.1": _command(name, one, summaries(parser)[name], version) for name, one in commands.items()
    }
    return {"lumiloop.1": _program(parser, version), **named}


def _head(title: str, version: str, text: str) -> list[str]:
    return [
        f'.TH "{title.upper()}" "1" "" "{escaped(version)}" "lumiloop"',
        ".SH NAME",
        f"{escaped(title)} \\- {escaped(text)}",
    ]


def _program(parser: argparse.ArgumentParser, version: str) -> str:
    lines = _head("lumiloop", version, "indoor robot localisation from a lidar and coded ceiling lights")
    lines += [".SH SYNOPSIS", ".B lumiloop", "[\\fIoptions\\fR] \\fIcommand\\fR [\\fIoptions\\fR]", ".SH DESCRIPTION"]
    lines += [escaped(" ".join((parser.description or "").split())), ".SH COMMANDS"]
    known = summaries(parser)
    for group in GROUPS:
        lines += [f".SS {escaped(group.title)}"]
        for name in group.commands:
            lines += [".TP", f".BR lumiloop\\-{escaped(name)} (1)", escaped(known[name])]
    lines += [".SH OPTIONS", *_options(parser), *_listed("FILES", FILES), *_listed("EXIT STATUS", EXIT_CODES)]
    return "\n".join(lines) + "\n"


def _command(name: str, parser: argparse.ArgumentParser, text: str, version: str) -> str:
    lines = [*_head(f"lumiloop-{name}", version, text), ".SH SYNOPSIS", *_synopsis(parser)]
    lines += [".SH OPTIONS", *_options(parser)]
    for verb, one in subcommands(parser).items():
        lines += [
            f".SH {escaped(verb.upper())}",
            escaped(summaries(parser)[verb]),
            ".PP",
            *_synopsis(one),
            *_options(one),
        ]
    lines += [".SH EXAMPLES"]
    for line, what in EXAMPLES[name]:
        lines += [".TP", f".B lumiloop {escaped(line)}", escaped(what)]
    lines += [*_listed("EXIT STATUS", EXIT_CODES), ".SH SEE ALSO", ".BR lumiloop (1)"]
    return "\n".join(lines) + "\n"


def _synopsis(parser: argparse.ArgumentParser) -> list[str]:
    usage = " ".join(parser.format_usage().removeprefix("usage:").split())
    return [f"\\fB{escaped(parser.prog)}\\fR {escaped(usage.removeprefix(parser.prog).strip())}"]


def _options(parser: argparse.ArgumentParser) -> list[str]:
    lines: list[str] = []
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction) or action.help == argparse.SUPPRESS:
            continue
        formatter = parser._get_formatter()
        words = formatter._format_action_invocation(action)
        text = formatter._expand_help(action) if action.help else ""
        lines += [".TP", f".B {escaped(words)}", escaped(text)]
    return lines


def _listed(title: str, rows: tuple[tuple[str, str], ...]) -> list[str]:
    lines = [f".SH {title}"]
    for word, text in rows:
        lines += [".TP", f".B {escaped(word)}", escaped(text)]
    return lines


def escaped(text: str) -> str:
    """Text for troff: backslashes, hyphens, and what would be a request at the beginning of a line."""
    plain = re.sub(r"\s+", " ", text).replace("\\", "\\e").replace("-", "\\-")
    return f"\\&{plain}" if plain[:1] in (".", "'") else plain
