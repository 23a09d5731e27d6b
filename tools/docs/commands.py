"""``python -m tools.docs.commands``: the page docs/commands.md from the program's own parser."""

import argparse
from collections.abc import Iterator
from typing import Final

from daemon.cli.parser import parser

HEAD: Final = """<!-- Written by `python -m tools.docs.commands`; edit the commands in daemon/cli, not this file. -->
# Commands

Every command prints the same with `--help`, and two examples with `lumiloop help COMMAND`. The installation has man
pages and completion for bash, zsh and fish. Elsewhere: `lumiloop man --out DIR`; `eval "$(lumiloop completion bash)"`,
with zsh after `compinit`; in fish `lumiloop completion fish | source`.

* **Exit code:** 0 done; 1 failed or refused; 2 wrong usage or configuration; 130 interrupted.
* **Output:** results go to stdout; notes, progress and errors go to stderr. Every command takes `-q` (errors and
  results only), `-v` (details too) and `--log-level`.
* **For programs:** `--json` prints one object with the key `schema`, as `"lumiloop.status/1"`. Names of quantities end
  with their unit (`age_s`, `x_m`); null means not known. A field never changes its meaning under the same schema.
* **Extras:** a command names what it needs beyond the core: `pip install 'lumiloop[NAME]'`.
"""
EVERYWHERE: Final = {"--help", "--verbose", "--quiet", "--log-level"}
"""Options of every command, which the head names."""
Choices = dict[str, argparse.ArgumentParser]


def commands(of: argparse.ArgumentParser, name: str = "lumiloop") -> Iterator[tuple[str, str, argparse.ArgumentParser]]:
    """Each command and verb below a parser: full name, summary, parser; a command with verbs before them."""
    for action in of._actions:
        if isinstance(action, argparse._SubParsersAction):
            choices: Choices = action.choices
            summaries = {one.dest: one.help or "" for one in action._choices_actions}
            for word, below in choices.items():
                yield f"{name} {word}", summaries.get(word, ""), below
                yield from commands(below, f"{name} {word}")


def options(of: argparse.ArgumentParser) -> list[tuple[str, str]]:
    """Words and help of each option and argument, those of every command left out."""
    formatter = of._get_formatter()
    rows = []
    for action in of._actions:
        shown = action.help != argparse.SUPPRESS and EVERYWHERE.isdisjoint(action.option_strings)
        if isinstance(action, argparse._SubParsersAction) or not shown:
            continue
        value = "" if action.nargs == 0 else _value(action)
        names = ", ".join(action.option_strings)
        text = " ".join(formatter._expand_help(action).split()) if action.help else ""
        rows.append((f"{names} {value}".strip(), text))
    return rows


def _value(action: argparse.Action) -> str:
    names = action.metavar or (
        "{" + ",".join(map(str, action.choices)) + "}" if action.choices else action.dest.upper()
    )
    named = " ".join(names) if isinstance(names, tuple) else names
    match action.nargs:
        case "?":
            return f"[{named}]"
        case "*":
            return f"[{named} ...]"
        case "+":
            return f"{named} [{named} ...]"
        case int(number) if not isinstance(names, tuple):
            return " ".join([named] * number)
    return named


def page() -> str:
    """The text of docs/commands.md."""
    every = list(commands(parser()))
    rows = [f"| [`{name}`](#{_anchor(name)}) | {_capital(summary)} |" for name, summary, _ in every]
    parts = [HEAD, "\n".join(["| command | what it does |", "| --- | --- |", *rows])]
    for name, _, one in every:
        told = [f"## {name}"]
        if one.description:
            told.append(" ".join(one.description.split()))
        if rows := [f"    {words:<28}  {text}".rstrip() for words, text in options(one)]:
            told.append("\n".join(rows))
        parts.append("\n\n".join(told))
    return "\n\n".join(parts).replace("\n\n\n", "\n\n") + "\n"


def _anchor(heading: str) -> str:
    return heading.replace(" ", "-")


def _capital(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def main() -> None:
    """Print the page."""
    print(page(), end="")


if __name__ == "__main__":
    main()
