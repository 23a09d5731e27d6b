"""Every contract with the outside as plain data, and what has changed of it since the release before.

    python -m tools.ci.contracts                    what is broken, and what is new
    python -m tools.ci.contracts --update           write down what is there now, beside the release before
    python -m tools.ci.contracts --freeze VERSION   at a release: freeze what is there now

A register, a byte, a number of a state or a key of the configuration that was there stays what it was; more may come.
A contract breaks only under a new version number of its own. What is new since that release may still change, but not
unnoticed: it is written down beside it. Only tables are read here, nothing runs.
"""

import argparse
import dataclasses
import json
import re
import struct
import sys
import typing
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

import msgspec

from daemon import snapshot
from daemon.config import loader
from daemon.health.faults import FAULTS
from daemon.health.reasons import REASONS
from daemon.maps import container
from daemon.publish import udp_subscriptions
from daemon.publish.modbus import (
    dimmed_block,
    holding,
    integrity_block,
    lights_block,
    parts_block,
    registers,
    timing_block,
)
from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import Layout
from daemon.publish.stream import fields as stream_fields
from daemon.publish.stream import server as stream_server
from daemon.recording.recorder import CommandEntry, CycleEntry
from hal.net import input_codec
from hal.replay import recording

FROZEN: Final = Path(__file__).parents[2] / "tests" / "daemon" / "publish" / "modbus" / "frozen" / "release.json"
NOW: Final = FROZEN.with_name("unreleased.json")
ENUMS: Final = ("State", "LightFix", "LinkUse", "LoopReason", "Part", "Thread", "Stage")

Items = dict[str, str]
Contracts = dict[str, dict[str, Any]]


def contracts() -> Contracts:
    """By name: the version number of a contract (0: it has none), and its items with what each is."""
    return {
        "configuration": _contract(0, _keys()),
        "modbus": _contract(registers.VERSION, _input_registers() | _mirror() | _bits()),
        "modbus lights": _block(lights_block.BLOCK),
        "modbus integrity": _block(integrity_block.BLOCK),
        "modbus cycle": _block(timing_block.BLOCK),
        "modbus parts": _block(parts_block.BLOCK),
        "modbus dimmed lamps": _block(dimmed_block.BLOCK),
        "modbus holding": _contract(0, _holding_registers()),
        "numbers": _contract(0, _numbers()),
        "pose datagram": _contract(registers.VERSION, _datagram()),
        "input datagrams": _contract(input_codec.VERSION, _sizes()),
        "subscription": _contract(
            udp_subscriptions.VERSION, _named("status", udp_subscriptions.Status) | _subscription()
        ),
        "stream": _contract(stream_server.SCHEMA, {f"topic {name}": "" for name in stream_server.TOPICS} | _stream()),
        "recordings": _contract(recording.VERSION, _named("kind", recording.Kind) | _records()),
        "map files": _contract(container.VERSION, {}),
    }


def differences(frozen: Contracts, now: Contracts) -> list[str]:
    """What a client of the frozen contracts would trip over: named, with what it was and what it is."""
    found = []
    for name, before in frozen.items():
        if (after := now.get(name)) is None:
            found.append(f"{name}: the whole contract is gone")
        elif after["version"] < before["version"]:
            found.append(f"{name}: version {before['version']} has become {after['version']}; versions only count up")
        elif after["version"] == before["version"]:
            found += [f"{name}: {text}" for text in _broken(before["items"], after["items"])]
    return found


def additions(frozen: Contracts, now: Contracts) -> list[str]:
    """What there was not in the frozen contracts, under the same version numbers."""
    found = []
    for name, after in now.items():
        before = frozen.get(name)
        if before is None:
            found.append(f"{name}: the whole contract, {len(after['items'])} items")
        elif after["version"] > before["version"]:
            found.append(f"{name}: version {after['version']}, which was {before['version']}")
        else:
            items = after["items"].items()
            found += [f"{name}: {key} ({value})" if value else f"{name}: {key}" for key, value in items
                      if key not in before["items"]]  # fmt: skip
    return found


def _broken(before: Items, after: Items) -> list[str]:
    gone = [key for key in before if key not in after and key.removeprefix("key ") not in loader.MOVED]
    changed = [key for key in before if key in after and before[key] != after[key]]
    return [
        *(f"{key} ({before[key]}) is gone" if before[key] else f"{key} is gone" for key in gone),
        *(f"{key} was {before[key]!r} and is {after[key]!r}" for key in changed),
    ]


def _contract(version: int, items: Items) -> dict[str, Any]:
    return {"version": version, "items": items}


def _keys() -> Items:
    return {f"key {option.path}": f"default {option.default!r}" for option in loader.options()}


def _points(place: str, layout: Layout, start: int, step: int = 1) -> Items:
    """By address: what a reader has to know of each point."""
    return {
        f"{place} {start + step * offset}": f"{p.name}: {p.wire.name}, 1/{p.per_unit} {p.unit}, {p.rule.value}, "
        + ("may be not known" if p.can_be_unknown else "always known")
        for offset, p in zip(layout.offsets, layout.points, strict=True)
    }


def _magic(address: int, magic: int) -> Items:
    return {f"register {address}": f"magic: {magic:#06x}"}


def _block(block: Block) -> dict[str, Any]:
    points = _points("register", block, block.body)
    return _contract(block.version, _magic(block.address, block.magic) | points)


def _input_registers() -> Items:
    return _magic(0, registers.MODBUS_MAGIC) | _points("register", registers.BODY, registers.BODY_ADDRESS)


def _mirror() -> Items:
    first = registers.MIRROR_ADDRESS + 2
    return {f"mirror {first + 2 * i}": f"{p.name}: float32, {p.unit}" for i, p in enumerate(registers.MIRROR)}


def _holding_registers() -> Items:
    command = _points("holding", holding.COMMAND, holding.COMMAND_ADDRESS)
    loop = _points("holding", holding.LOOP, holding.LOOP_ADDRESS)
    return command | loop | _points("holding", holding.ODOMETRY, holding.ODOMETRY_ADDRESS)


def _datagram() -> Items:
    body = _points("byte", registers.BODY, registers.BODY_OFFSET, 2)
    light = _points("byte", lights_block.TAIL, registers.TAIL_OFFSET, 2)
    return body | light | _points("byte", integrity_block.TAIL, registers.TRUST_OFFSET, 2)


def _bits() -> Items:
    tables = {"flags": registers.FLAGS, "devices": registers.DEVICES, "witnesses": integrity_block.WITNESSES}
    return {f"bit {i} of {name}": bit[0] for name, table in tables.items() for i, bit in enumerate(table)}


def _named(what: str, table: Iterable[IntEnum]) -> Items:
    return {f"{what} {one.value}": one.name for one in table}


def _numbers() -> Items:
    found = _named("command", holding.CommandCode) | _named("result", holding.Outcome)
    for name in ENUMS:
        found |= _named(name, getattr(snapshot, name))
    return found | _named("fault", FAULTS) | _named("reason", REASONS)


def _sizes() -> Items:
    return {"odometry": f"{input_codec.ODOMETRY_SIZE} bytes", "imu": f"{input_codec.IMU_SIZE} bytes"}


def _subscription() -> Items:
    """Bytes of a request and of its answer, which have one layout."""
    found, at = {"magic": udp_subscriptions.MAGIC.decode(), "length": f"{udp_subscriptions.SIZE} bytes"}, 0
    for name, code in (*udp_subscriptions.LAYOUT, ("CRC-32 of what is before it", "I")):
        found[f"byte {at}"] = f"{name}: <{code}"
        at += struct.calcsize(f"<{code}")
    return found


def _stream() -> Items:
    found = {
        f"field {name} of {topic}": kind
        for topic, table in stream_fields.FIELDS.items()
        for name, kind in table.items()
    }
    for topic, record in stream_fields.RECORDS.items():
        found |= {f"field {name} of {topic}": kind for name, kind in _fields("", record)}
    return found


def _fields(before: str, record: type) -> Iterable[tuple[str, str]]:
    """Names and types of a record, and of the records within it."""
    for field in dataclasses.fields(record):
        kind = str(field.type)
        yield before + field.name, kind
        for name in re.findall(r"[A-Z]\w+", kind):
            if dataclasses.is_dataclass(inner := getattr(snapshot, name, None)):
                yield from _fields(f"{before}{field.name}.", inner)  # type: ignore[arg-type]  # a class: the module's


def _records() -> Items:
    layouts = {f"{name}": layout for name, layout in recording.HEAD.items()}
    layouts |= {f"payload of {kind.name}": f"{layout}: {names}" for kind, (layout, names) in recording.LAYOUTS.items()}
    for name, entry in (("CYCLE", CycleEntry), ("a command of CYCLE", CommandEntry)):
        for number, field in enumerate(msgspec.structs.fields(entry)):
            kind = str(field.type) if typing.get_args(field.type) else field.type.__name__
            layouts[f"field {number} of {name}"] = f"{field.name}: {kind}"
    return layouts


def main() -> int:
    """Exit status 1 where something is broken."""
    parser = argparse.ArgumentParser(prog="python -m tools.ci.contracts", description=__doc__)
    parser.add_argument("--freeze", metavar="VERSION", help="write what is there now as that release's contracts")
    parser.add_argument("--update", action="store_true", help=f"write what is there now into {NOW.name}")
    options = parser.parse_args()
    now = contracts()
    if options.freeze:
        _write(FROZEN, options.freeze, now)
    if options.freeze or options.update:
        _write(NOW, "unreleased", now)
        return 0
    frozen = json.loads(FROZEN.read_text())
    new = additions(frozen["contracts"], now)
    found = differences(frozen["contracts"], now)
    print(
        *(f"new: {text}" for text in new),
        *(f"BROKEN: {text}" for text in found),
        sep="\n",
        end="\n" * bool(new + found),
    )
    print(f"{len(found) or 'nothing'} broken since {frozen['release']}, {len(new) or 'nothing'} new")
    return int(bool(found))


def _write(path: Path, release: str, now: Contracts) -> None:
    path.write_text(json.dumps({"release": release, "contracts": now}, indent=1) + "\n")


if __name__ == "__main__":
    sys.exit(main())
