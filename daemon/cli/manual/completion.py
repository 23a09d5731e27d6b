"""Completion scripts for bash, zsh and fish, made from the parsers. They start no program while a user types."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import Final

from daemon.cli.manual.command_parser import every, subcommands, summaries

BASH: Final = """\
# bash completion of lumiloop; written by `lumiloop completion bash`
_lumiloop() {{
    local cur=${{COMP_WORDS[COMP_CWORD]}} path="" word words at
    for ((at = 1; at < COMP_CWORD; at++)); do
        word=${{COMP_WORDS[at]}}
        case "$path $word" in
            {paths}) path="$path $word" ;;
        esac
    done
    case "$path" in
{cases}
    esac
    COMPREPLY=($(compgen -W "$words" -- "$cur"))
    if [[ $cur != -* ]]; then
        compopt -o filenames 2> /dev/null
        COMPREPLY+=($(compgen -f -- "$cur"))
    fi
}}
complete -F _lumiloop lumiloop
"""

ZSH: Final = """\
#compdef lumiloop
# zsh completion of lumiloop; written by `lumiloop completion zsh`
_lumiloop() {{
    local context="" word at
    local -a entries options
    for ((at = 2; at < CURRENT; at++)); do
        word=$words[at]
        case "$context $word" in
            {paths}) context="$context $word" ;;
        esac
    done
    case "$context" in
{cases}
    esac
    if [[ $PREFIX = -* ]]; then
        _describe -o option options
    else
        _describe command entries
        _files
    fi
}}
if [[ $funcstack[1] = _lumiloop ]]; then _lumiloop; else compdef _lumiloop lumiloop; fi
"""


def script(shell: str, parser: argparse.ArgumentParser) -> str:
    """The completion script for a shell: bash, zsh or fish."""
    return {"bash": _bash, "zsh": _zsh, "fish": _fish}[shell](parser)


def options(parser: argparse.ArgumentParser) -> list[tuple[str, str, bool]]:
    """The options of a command: each word, its help, and whether it takes a value."""
    found = []
    for action in parser._actions:
        text = (action.help or "").replace("%(default)s", str(action.default))
        found += [(word, text, action.nargs != 0) for word in action.option_strings]
    return found


def values(parser: argparse.ArgumentParser) -> dict[str, str]:
    """The commands, verbs or fixed words that may stand next, each with its help (empty for a fixed word)."""
    fixed = [action.choices or () for action in parser._actions if not action.option_strings]
    return {str(word): "" for words in fixed for word in words} | summaries(parser)


def _contexts(parser: argparse.ArgumentParser) -> list[tuple[str, argparse.ArgumentParser]]:
    """Every command with the words that precede what is completed, as the scripts join them."""
    return [("", parser), *(("".join(f" {word}" for word in words), one) for words, one in every(parser))]


def _bash(parser: argparse.ArgumentParser) -> str:
    cases = []
    for context, one in _contexts(parser):
        words = [*values(one), *(word for word, _, _ in options(one))]
        cases.append(f'        "{context}") words="{" ".join(words)}" ;;')
    return BASH.format(paths=_paths(parser), cases="\n".join(cases))


def _paths(parser: argparse.ArgumentParser) -> str:
    return "|".join(f'"{context}"' for context, _ in _contexts(parser) if context)


def _zsh(parser: argparse.ArgumentParser) -> str:
    cases = []
    for context, one in _contexts(parser):
        entries = _described(values(one).items())
        described = _described((word, text) for word, text, _ in options(one))
        cases.append(f'        "{context}") entries=({entries}) options=({described}) ;;')
    return ZSH.format(paths=_paths(parser), cases="\n".join(cases))


def _described(rows: Iterable[tuple[str, str]]) -> str:
    """Words with their help, as elements of an array for zsh's `_describe`."""
    return " ".join(_quoted(f"{word.replace(':', chr(92) + ':')}:{text}") for word, text in rows)


def _fish(parser: argparse.ArgumentParser) -> str:
    lines = ["# fish completion of lumiloop; written by `lumiloop completion fish`"]
    for context, one in _contexts(parser):
        words = context.split()
        seen = "; and ".join(f"__fish_seen_subcommand_from {word}" for word in words)
        below = " ".join(subcommands(one))
        deepest = f"not __fish_seen_subcommand_from {below}" if below else ""
        where = "; and ".join(filter(None, (seen, deepest))) or "__fish_use_subcommand"
        begin = f"complete -c lumiloop -n {_quoted(where)}"
        lines += [f"{begin} -a {word} -d {_quoted(text)}" for word, text in values(one).items()]
        for word, text, value in options(one):
            kind = f"-l {word[2:]}" if word.startswith("--") else f"-s {word[1:]}"
            lines.append(f"{begin} {kind}{' -r' if value else ''} -d {_quoted(text)}")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    """A word for a shell, in single quotes."""
    return "'" + text.replace("'", "'\\''") + "'"
