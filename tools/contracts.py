"""Every contract with the outside as plain data, and what has changed of it since the release before.

    python -m tools.contracts                    what differs from the frozen ones
    python -m tools.contracts --freeze VERSION   at a release: freeze what is there now

A register, a byte, a number of a state or a key of the configuration that was there stays what it was; more may come.
A contract breaks only under a new version number of its own. Only tables are read here, nothing runs.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable
from enum import IntEnum
from pathlib import Path
from typing import Any, Final

from daemon import configfile, store_file
from daemon.health import FAULTS
from daemon.publish import holding, integrity, lights, parts, pulse, registers, snapshot, stream, subscribe
from daemon.publish.points import Layout
from daemon.reasons import REASONS
from hal import input_codec
from hal.replay import recording

FROZEN: Final = Path(__file__).parent.parent / "tests" / "daemon" / "publish" / "frozen" / "release.json"
ENUMS: Final = ("State", "LightFix", "LinkUse", "LoopReason", "Part", "Thread")

Items = dict[str, str]
Contracts = dict[str, dict[str, Any]]


def contracts() -> Contracts:
    """By name: the version number of a contract (0: it has none), and its items with what each is."""
    return {
        "configuration": _contract(0, _keys()),
        "modbus": _contract(registers.VERSION, _input_registers() | _mirror() | _bits()),
        "modbus lights": _contract(lights.VERSION, _points("register", lights.BLOCK, lights.BODY_ADDRESS)),
        "modbus integrity": _contract(integrity.VERSION, _points("register", integrity.BLOCK, integrity.BODY_ADDRESS)),
        "modbus cycle": _contract(pulse.VERSION, _points("register", pulse.BLOCK, pulse.BODY_ADDRESS)),
        "modbus parts": _contract(parts.VERSION, _points("register", parts.BLOCK, parts.BODY_ADDRESS)),
        "modbus holding": _contract(0, _holding_registers()),
        "numbers": _contract(0, _numbers()),
        "pose datagram": _contract(registers.VERSION, _datagram()),
        "input datagrams": _contract(input_codec.VERSION, _sizes()),
        "subscription": _contract(subscribe.VERSION, _named("status", subscribe.Status)),
        "stream": _contract(stream.SCHEMA, {f"topic {name}": "" for name in stream.TOPICS}),
        "recordings": _contract(recording.VERSION, {}),
        "map files": _contract(store_file.VERSION, {}),
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


def _broken(before: Items, after: Items) -> list[str]:
    gone = [key for key in before if key not in after and key.removeprefix("key ") not in configfile.MOVED]
    changed = [key for key in before if key in after and before[key] != after[key]]
    return [
        *(f"{key} ({before[key]}) is gone" if before[key] else f"{key} is gone" for key in gone),
        *(f"{key} was {before[key]!r} and is {after[key]!r}" for key in changed),
    ]


def _contract(version: int, items: Items) -> dict[str, Any]:
    return {"version": version, "items": items}


def _keys() -> Items:
    return {f"key {option.path}": f"default {option.default!r}" for option in configfile.options()}


def _points(place: str, layout: Layout, start: int, step: int = 1) -> Items:
    """By address: what a reader has to know of each point."""
    return {
        f"{place} {start + step * offset}": f"{p.name}: {p.wire.name}, 1/{p.per_unit} {p.unit}, {p.rule.value}, "
        + ("may be not known" if p.can_be_unknown else "always known")
        for offset, p in zip(layout.offsets, layout.points, strict=True)
    }


def _input_registers() -> Items:
    return _points("register", registers.BODY, registers.BODY_ADDRESS)


def _mirror() -> Items:
    first = registers.MIRROR_ADDRESS + 2
    return {f"mirror {first + 2 * i}": f"{p.name}: float32, {p.unit}" for i, p in enumerate(registers.MIRROR)}


def _holding_registers() -> Items:
    command = _points("holding", holding.COMMAND, holding.COMMAND_ADDRESS)
    loop = _points("holding", holding.LOOP, holding.LOOP_ADDRESS)
    return command | loop | _points("holding", holding.ODOMETRY, holding.ODOMETRY_ADDRESS)


def _datagram() -> Items:
    body = _points("byte", registers.BODY, registers.BODY_OFFSET, 2)
    light = _points("byte", lights.TAIL, registers.TAIL_OFFSET, 2)
    return body | light | _points("byte", integrity.TAIL, registers.TRUST_OFFSET, 2)


def _bits() -> Items:
    tables = {"flags": registers.FLAGS, "devices": registers.DEVICES, "witnesses": integrity.WITNESSES}
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


def main() -> int:
    """Exit status 1 where something is broken."""
    parser = argparse.ArgumentParser(prog="python -m tools.contracts", description=__doc__)
    parser.add_argument("--freeze", metavar="VERSION", help="write what is there now as that release's contracts")
    options = parser.parse_args()
    if options.freeze:
        FROZEN.write_text(json.dumps({"release": options.freeze, "contracts": contracts()}, indent=1) + "\n")
        return 0
    frozen = json.loads(FROZEN.read_text())
    found = differences(frozen["contracts"], contracts())
    print("\n".join(found) or f"nothing is broken since {frozen['release']}")
    return int(bool(found))


if __name__ == "__main__":
    sys.exit(main())
