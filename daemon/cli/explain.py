"""``lumiloop explain WORD``: explains a key, a state, a number in the log or a register, and gives the remedy.

All texts come from the tables that the daemon itself uses, so that an explanation cannot become outdated.
"""

from __future__ import annotations

import argparse
import difflib
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Final

from daemon.cli.reports.output import print_report
from daemon.cli.status_table import WORDS as STATUS_WORDS
from daemon.config import loader
from daemon.config.schema import Config
from daemon.health.faults import FAULTS
from daemon.health.reasons import REASONS
from daemon.publish.meanings import COMMANDS, FIXES, LOOPS, STATES, USES
from daemon.publish.modbus import holding, integrity_block, parts_block, registers, timing_block
from daemon.publish.modbus.points import Layout, Point
from daemon.publish.modbus.requests import BLOCKS
from daemon.system.console import FAILED, OK, fail

_INPUT: Final = "input register"
_BLOCKS: Final = (
    (_INPUT, registers.BODY_ADDRESS, registers.BODY),
    *((_INPUT, block.body, block) for block in BLOCKS),
    ("holding register", holding.COMMAND_ADDRESS, holding.COMMAND),
    ("holding register", holding.LOOP_ADDRESS, holding.LOOP),
    ("holding register", holding.ODOMETRY_ADDRESS, holding.ODOMETRY),
)
_FRAMES: Final = (
    (0, registers.BLOCK_WORDS, registers.MODBUS_MAGIC, registers.VERSION),
    *((block.address, block.registers, block.magic, block.version) for block in BLOCKS),
)
"""Of each block with a head its address, number of registers, magic and version."""
_BITS: Final = (
    ("bit of `flags`", registers.FLAGS),
    ("bit of `devices`", registers.DEVICES),
    ("bit of `witnesses`", integrity_block.WITNESSES),
)
_PORTS: Final = (
    (Config().modbus.port, "MODBUS_PORT", "Modbus server of the daemon on UDP and TCP", "`modbus.port` changes it"),
    (8090, "WEB_PAGE", "web page of `lumiloop view`", "`--port` changes it"),
    (8765, "FOXGLOVE", "server of `lumiloop foxglove` for the Foxglove app", "`--listen` changes it"),
    (9464, "METRICS", "Prometheus metrics of `lumiloop metrics`", "`--listen` changes it"),
    (7447, "ZENOH_ROUTER", "Zenoh router of `lumiloop fleet` and `lumiloop ros2`", "`--router` changes it"),
)
"""Default ports."""
_DIGITS: Final = 10
"""Digits of the longest number, of 32 bits."""
_MOST: Final = 12
"""Explanations printed for one word; a whole table of keys has fewer."""


@dataclass(frozen=True, slots=True)
class Entry:
    """An item that can be explained.

    Attributes:
        kind: fault, reason, configuration key... name: as it is written. numbers: that identify it.
        text: its meaning. remedy: what to do, empty if nothing needs to be done.
    """

    kind: str
    name: str
    numbers: range
    text: str
    remedy: str = ""

    def as_object(self) -> dict[str, Any]:
        """Returns the entry for a program; ``numbers``: first and last one."""
        numbers = [self.numbers[0], self.numbers[-1]] if self.numbers else None
        return {
            "kind": self.kind,
            "name": self.name,
            "numbers": numbers,
            "text": self.text,
            "remedy": self.remedy or None,
        }

    def __str__(self) -> str:
        number = f" {self.numbers[0]}" if self.numbers else ""
        remedy = f"\n  what to do: {self.remedy}" if self.remedy else ""
        return f"{self.kind}{number}: {self.name}\n  {self.text}{remedy}"


def main(args: argparse.Namespace) -> int:
    """Runs the command; ``args.words``: one word, or a kind and a word as in `fault 302`."""
    asked = " ".join(args.words).strip().strip("`")
    everything = list(entries())
    found = find(asked, everything)
    if args.json:
        hint = "" if found else _hint(asked, everything)
        print_report(
            "explain", {"asked": asked, "entries": [entry.as_object() for entry in found], "hint": hint or None}
        )
        return OK if found else FAILED
    if not found:
        return fail(f"{asked}: no such name or number; {_hint(asked, everything)}", FAILED)
    sys.stdout.write("\n\n".join(str(entry) for entry in found[:_MOST]) + "\n")
    if len(found) > _MOST:
        sys.stdout.write(f"\nand {len(found) - _MOST} more; give a kind or a longer name\n")
    return OK


def _hint(asked: str, everything: Sequence[Entry]) -> str:
    kind = asked.lower()
    for entry in everything:
        if entry.numbers and kind in (entry.kind, entry.kind.rpartition(" ")[2]):
            return f"add a number, as in: {kind} {entry.numbers[0]}"
    names = {entry.name.lower() for entry in everything}
    near = sorted(name for name in names if _inside(asked.lower(), name))[:3]
    if not near and not asked[-1:].isdigit():
        near = difflib.get_close_matches(asked.lower(), names, n=3, cutoff=0.7)
    if near:
        return f"did you mean {' or '.join(near)}?"
    kinds = "a key, a state, a fault, a reason, a command, a register, a bit or a port"
    return f"name {kinds}, as in: fault 302, TRACKING, bind"


def _inside(asked: str, name: str) -> bool:
    """Whether a name contains a requested word, as `cycle.budget_ms` contains `budget`."""
    return asked in re.split(r"[._]", name)


def entries() -> Iterator[Entry]:
    """Yields all items that can be explained."""
    for option in loader.options():
        default = loader.value_text(option.default)
        yield Entry(
            "configuration key", option.path, range(0), f"{option.description} ({option.kind}; default {default})"
        )
    for path, remedy in loader.MOVED.items():
        yield Entry("configuration key of earlier versions", path, range(0), "this key has been removed", remedy)
    yield from _meanings("reason", REASONS)
    yield from _meanings("fault", FAULTS)
    yield from _names("state", STATES)
    yield from _names("light fix", FIXES)
    yield from _names("link use", USES)
    yield from _names("loop reason", LOOPS)
    yield from _names("command", COMMANDS)
    yield from _names("component", parts_block.PARTS)
    yield from _names("thread", parts_block.THREADS)
    yield from _names("stage", timing_block.STAGES)
    for name, text in STATUS_WORDS.items():
        yield Entry("word of `lumiloop status`", name, range(0), text)
    for port, name, text, remedy in _PORTS:
        yield Entry("port", name, range(port, port + 1), text, remedy)
    yield from _registers()


def _meanings(kind: str, table: Mapping[Any, tuple[str, str]]) -> Iterator[Entry]:
    for code, (text, remedy) in table.items():
        yield Entry(kind, code.name, _one(code), text, remedy)


def _names(kind: str, table: Mapping[Any, str]) -> Iterator[Entry]:
    for code, text in table.items():
        yield Entry(kind, code.name, _one(code), text)


def _registers() -> Iterator[Entry]:
    for kind, start, layout in _BLOCKS:
        yield from _points(kind, start, layout)
    yield from _mirror()
    yield from _frames()
    for kind, bits in _BITS:
        for number, (name, text, _) in enumerate(bits):
            yield Entry(kind, name, range(number, number + 1), f"set when {text}")


def _points(kind: str, start: int, layout: Layout) -> Iterator[Entry]:
    for offset, point in zip(layout.offsets, layout.points, strict=True):
        step = f", steps of 1/{point.per_unit} {point.unit}" if point.per_unit > 1 else ""
        text = f"{point.label}. {_elsewhere(point)}".strip().rstrip(".") + f" ({point.wire.name}{step})"
        yield Entry(kind, point.name, range(start + offset, start + offset + point.wire.words), text)


def _mirror() -> Iterator[Entry]:
    start = registers.MIRROR_ADDRESS
    yield Entry(_INPUT, "seq", range(start, start + 2), "snapshot number (uint32)")
    for number, point in enumerate(registers.MIRROR, 1):
        at = start + 2 * number
        yield Entry(_INPUT, point.name, range(at, at + 2), f"{point.label} (float32, {point.unit or 'no unit'})")
    end = start + registers.MIRROR_WORDS
    yield Entry(_INPUT, "seq_end", range(end - 2, end), "the same as `seq` (uint32)")


def _frames() -> Iterator[Entry]:
    for start, words, magic, version in _FRAMES:
        end = start + words
        yield Entry(_INPUT, "magic", range(start, start + 1), f"0x{magic:04X}: start of this block (uint16)")
        yield Entry(_INPUT, "version", range(start + 1, start + 2), f"version of this block: {version} (uint16)")
        yield Entry(_INPUT, "seq_end", range(end - 2, end), "the same as `seq`: the block is of one snapshot (uint32)")


def _elsewhere(point: Point) -> str:
    """Returns the point's text, with the command to run in place of a reference to a table."""
    kind = "link use" if point.name.endswith("_use") else point.name
    text = point.text.replace("Bits, see below", "Bits; for their meaning: lumiloop explain bit NUMBER")
    return text.replace("See below", f"For the meaning: lumiloop explain {kind} NUMBER")


def _one(code: IntEnum) -> range:
    return range(code.value, code.value + 1)


def find(asked: str, everything: Sequence[Entry]) -> list[Entry]:
    """Returns the entries of a number or name, of one kind if the first words name it.

    A table's name gives its keys, too.
    """
    kind, _, last = asked.lower().rpartition(" ")
    of_kind = [entry for entry in everything if kind in entry.kind]
    if last.isascii() and last.isdigit() and len(last) <= _DIGITS:
        return [entry for entry in of_kind if int(last) in entry.numbers]
    named = _named(asked.lower().split(), everything)
    within = [entry for entry in of_kind if f".{last}." in f".{entry.name.lower()}."]
    return [*named, *(entry for entry in within if entry not in named)]


def _named(words: Sequence[str], everything: Sequence[Entry]) -> list[Entry]:
    """Returns the entries with the longest name that the last words form, of the kind of the words before them."""
    for cut in range(len(words)):
        kind, name = " ".join(words[:cut]), " ".join(words[cut:])
        if found := [entry for entry in everything if kind in entry.kind and entry.name.lower() == name]:
            return found
    return []
