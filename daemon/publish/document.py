"""Writes `docs/modbus.md` and `docs/udp.md` from the tables: `python -m daemon.publish.document [FOLDER]`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from daemon.health import FAULTS
from daemon.publish import holding, integrity, lights, modbus, pulse, registers, requests
from daemon.publish.points import Layout, Point, Rule
from daemon.publish.snapshot import LightFix, LinkUse, LoopReason, State
from daemon.reasons import REASONS
from hal import input_codec, inputs

_NOTICE: Final = (
    "<!-- Written by `python -m daemon.publish.document`; edit the tables in daemon/publish, not this file. -->"
)
_NOT_KNOWN: Final = """A value that is not known reads as all ones (unsigned) or as the smallest number (signed), as
SunSpec's "not implemented"; the column says where that can happen. Measurements saturate and never wrap. Counters wrap:
take differences, modulo their width."""


def table(head: tuple[str, ...], rows: Iterable[tuple[str, ...]]) -> str:
    """A Markdown table."""
    lines = [head, tuple("---" for _ in head), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _step(point: Point) -> str:
    unit = f" {point.unit}" if point.unit else ""
    return f"1/{point.per_unit}{unit}" if point.per_unit > 1 else point.unit


def _not_known(point: Point) -> str:
    width = point.wire.bits // 4
    return f"0x{point.wire.not_known % (1 << point.wire.bits):0{width}X}" if point.can_be_unknown else ""


def _describe(point: Point) -> str:
    wraps = " Wraps." if point.rule is Rule.WRAP else ""
    return f"{point.label[0].upper()}{point.label[1:]}. {point.text}{wraps}".strip()


def _rows(layout: Layout, start: int, step: int) -> list[tuple[str, ...]]:
    """Rows of a layout; `start` and `step` turn a word offset into a register address or a byte."""
    return [
        (str(start + step * offset), f"`{p.name}`", p.wire.name, _step(p), _not_known(p), _describe(p))
        for offset, p in zip(layout.offsets, layout.points, strict=True)
    ]


def _holding_rows(layout: Layout, start: int) -> list[tuple[str, ...]]:
    return [
        (str(start + offset), f"`{p.name}`", p.wire.name, p.access, _step(p), _not_known(p), _describe(p))
        for offset, p in zip(layout.offsets, layout.points, strict=True)
    ]


def _bit_rows(bits: tuple[registers.Bit, ...]) -> list[tuple[str, ...]]:
    return [(str(number), f"`{name}`", text) for number, (name, text, _) in enumerate(bits)]


def _state_rows() -> list[tuple[str, ...]]:
    meaning: dict[State, str] = {
        State.STARTING: "warming up, nothing to say yet",
        State.NO_LIDAR: "no valid scan for three scan periods",
        State.MAPPING: "the pose follows the laser, but no witness has proved it yet",
        State.TRACKING: "two witnesses agree, or one has proved itself",
        State.DEGRADED: "the pose is held, at least one axis or witness is missing",
        State.AMBIGUOUS: "several places fit",
        State.LOST: "no pose worth using",
        State.RELOCATING: "looking for the place",
    }
    return [(str(state.value), state.name, meaning[state]) for state in State]


def _meaning_rows(meanings: Mapping[Any, tuple[str, str]]) -> list[tuple[str, ...]]:
    return [(str(int(number)), text, remedy) for number, (text, remedy) in meanings.items()]


def _codes() -> str:
    return f"""## States

{table(("number", "state", "meaning"), _state_rows())}

## Reasons

{table(("number", "reason", "what to do"), _meaning_rows(REASONS))}

## Faults

{table(("number", "fault", "what to do"), _meaning_rows(FAULTS))}

## Bits of `flags`

{table(("bit", "name", "set when"), _bit_rows(registers.FLAGS))}

## Bits of `devices`

{table(("bit", "name", "set when"), _bit_rows(registers.DEVICES))}
"""


def modbus_page() -> str:
    """The text of `docs/modbus.md`."""
    end = registers.BLOCK_WORDS - 2
    block = [
        ("0", "`magic`", "uint16", "", "", f"0x{registers.MODBUS_MAGIC:04X} (\"LL\")."),
        ("1", "`version`", "uint16", "", "", f"Version of this table: {registers.VERSION}."),
        *_rows(registers.BODY, registers.BODY_ADDRESS, 1),
        (str(end), "`seq_end`", "uint32", "", "", "The same as `seq`: the block was read whole."),
    ]  # fmt: skip
    first = registers.MIRROR_ADDRESS
    last = first + 2 + 2 * len(registers.MIRROR)
    mirror = [
        (str(first), "`seq`", "uint32", "", "Snapshot number."),
        *(
            (str(first + 2 + 2 * i), f"`{p.name}`", "float32", p.unit, _capital(p.label))
            for i, p in enumerate(registers.MIRROR)
        ),
        (str(last), "`seq_end`", "uint32", "", "The same as `seq`."),
    ]  # fmt: skip
    return f"""{_NOTICE}
# Modbus

The daemon is a Modbus server on UDP and TCP, port 1502 unless `modbus.port` says otherwise, on the loopback address
unless `bind` does. Read **{registers.BLOCK_WORDS} input registers from address 0 in one request** (function 4; function
3 shows the same): the answer is one snapshot, whole, of the last cycle. It is not a safety function.

* Addresses are the protocol's, from 0. Tools that count from 1 call the first register 30001 (function 4) or 40001.
* Big-endian: high byte first within a register, **high word first** in 32- and 64-bit values.
* Any unit identifier is answered. Over UDP, one datagram is one request; repeat it when no answer comes.
* A register map never changes under the same `version`. Check `magic` and `version` once.
* In two requests you may see two snapshots: compare `seq` with `seq_end`.
* Modbus has no password: keep the port on a network you trust.
* Watch `heartbeat`: if it stands still, the daemon's cycle does. Use the pose only in a `state` your machine accepts.

{_NOT_KNOWN}

## The block: input registers 0 to {registers.BLOCK_WORDS - 1}

{table(("address", "name", "type", "step", "not known", "meaning"), block)}

{_codes()}
## Float mirror: input registers {first} to {last + 1}

The scaled values again as IEEE 754 float32 in SI units, and the full covariance of the map pose. NaN: not known.

{table(("address", "name", "type", "unit", "meaning"), mirror)}

{_lights()}
{_integrity()}
{_pulse()}
{_writing()}
## Limits

{_limits()}
"""


_USES: Final[dict[LinkUse, str]] = {
    LinkUse.OTHER: "something that this version does not know",
    LinkUse.ACCEPTED: "used",
    LinkUse.OCCLUDED: "weaker than it can be here: something stands in its way",
    LinkUse.REJECTED: "stronger than it can be here, or from the wrong place: moved, or exchanged",
    LinkUse.RIM: "at the edge of the receiver's field of view",
    LinkUse.FAINT: "not above the noise",
    LinkUse.TWIN: "two lamps of this code are in view",
    LinkUse.UNSURVEYED: "no lamp of this code is known",
    LinkUse.MISSING: "not received, though it must be here: dead, or covered",
    LinkUse.PAUSED: "clear, but not among those that are used",
}
_FIXES: Final[dict[LightFix, str]] = {
    LightFix.NONE: "no lamps in view, or too few",
    LightFix.STARTING: "position known, heading and strengths still being found",
    LightFix.GOOD: "position and heading known",
    LightFix.HELD: "carried on by odometry alone, every link is paused",
    LightFix.AMBIGUOUS: "several places fit",
    LightFix.LOST: "what is received contradicts the position: starting anew",
}


def _lights() -> str:
    first, width = lights.ADDRESS, lights.ROW_WORDS
    last = first + lights.BLOCK_WORDS - 1
    head = [row for row in _rows(lights.BLOCK, lights.BODY_ADDRESS, 1) if not row[1].startswith("`link_")]
    start = lights.BODY_ADDRESS + lights.BLOCK.offsets[len(head)]
    rows = [row for row in _rows(lights.BLOCK, lights.BODY_ADDRESS, 1) if row[1].startswith("`link_1_")]
    block = [
        (str(first), "`magic`", "uint16", "", "", f"0x{lights.MAGIC:04X} (\"LI\")."),
        (str(first + 1), "`version`", "uint16", "", "", f"Version of this table: {lights.VERSION}."),
        *head,
        *rows,
        (str(last - 1), "`seq_end`", "uint32", "", "", "The same as `seq`: the block was read whole."),
    ]  # fmt: skip
    words, links = lights.BLOCK_WORDS, lights.ROWS
    return f"""## Lights: input registers {first} to {last}

The lamps in view, strongest first, and the position from lights alone, which the laser never touches. Read
**{words} registers from address {first} in one request**. There are {links} links, the strongest first; link k
begins at {start} + {width} (k - 1), and the table shows the first.

{table(("address", "name", "type", "step", "not known", "meaning"), block)}

{table(("`light_fix`", "name", "meaning"), [(str(fix.value), fix.name, _FIXES[fix]) for fix in LightFix])}

{table(("`link_..._use`", "name", "meaning"), [(str(use.value), use.name, _USES[use]) for use in LinkUse])}
"""


_LOOPS: Final[dict[LoopReason, str]] = {
    LoopReason.OTHER: "something that this version does not know",
    LoopReason.NEAR: "laser: the scan fits the map where it was expected",
    LoopReason.SEARCHED: "laser: the scan fits the map in one place of all that were possible",
    LoopReason.SUPPORTED: "laser, twice: two keyframes from different places agree on it",
    LoopReason.LIT: "light and laser: the same lamps are seen from the same place, and the scan fits the map there",
    LoopReason.PLACED: "found in the whole map: the one place that fits all that was seen since the place was lost",
}


def _integrity() -> str:
    first = integrity.ADDRESS
    last = first + integrity.BLOCK_WORDS - 1
    block = [
        (str(first), "`magic`", "uint16", "", "", f"0x{integrity.MAGIC:04X} (\"LP\")."),
        (str(first + 1), "`version`", "uint16", "", "", f"Version of this table: {integrity.VERSION}."),
        *_rows(integrity.BLOCK, integrity.BODY_ADDRESS, 1),
        (str(last - 1), "`seq_end`", "uint32", "", "", "The same as `seq`: the block was read whole."),
    ]  # fmt: skip
    return f"""## Integrity: input registers {first} to {last}

How far the pose can be trusted; what a protection level is, and at which risk it holds, says
[Integrity](integrity.md). Read **{integrity.BLOCK_WORDS} registers from address {first} in one request**.

{table(("address", "name", "type", "step", "not known", "meaning"), block)}

{table(("bit of `witnesses`", "name", "set when"), _bit_rows(integrity.WITNESSES))}

{table(("`loop_reason`", "name", "meaning"), [(str(why.value), why.name, _LOOPS[why]) for why in LoopReason])}
"""


def _pulse() -> str:
    first = pulse.ADDRESS
    last = first + pulse.BLOCK_WORDS - 1
    block = [
        (str(first), "`magic`", "uint16", "", "", f"0x{pulse.MAGIC:04X} (\"LC\")."),
        (str(first + 1), "`version`", "uint16", "", "", f"Version of this table: {pulse.VERSION}."),
        *_rows(pulse.BLOCK, pulse.BODY_ADDRESS, 1),
        (str(last - 1), "`seq_end`", "uint32", "", "", "The same as `seq`: the block was read whole."),
    ]  # fmt: skip
    return f"""## The cycle: input registers {first} to {last}

What the daemon leaves out where the computer is too slow, how long the stages of a cycle take, and when it stood still.
Medians and the like are those of the last half minute to minute. Read **{pulse.BLOCK_WORDS} registers from address
{first} in one request**.

{table(("address", "name", "type", "step", "not known", "meaning"), block)}
"""


def _capital(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _writing() -> str:
    head = ("address", "name", "type", "access", "step", "not known", "meaning")
    return f"""## Writing: holding registers

Only with `modbus.write = true`; otherwise every write is answered with exception 1. Functions 6 and 16; function 3
reads back. Anyone who can reach the port can write.

### Command block, {holding.COMMAND_ADDRESS} to {holding.COMMAND_ADDRESS + holding.COMMAND.words - 1}

Write `command` and its parameters, and a new number into `request` (all in one request, or `request` last). The
command is finished when `acknowledge` equals that number; `result` says how it ended. Writing a request again does
nothing, so a repeated UDP datagram does no harm; a newer request replaces one that is still running.

{table(head, _holding_rows(holding.COMMAND, holding.COMMAND_ADDRESS))}

### Odometry input, {holding.ODOMETRY_ADDRESS} to {holding.ODOMETRY_ADDRESS + holding.ODOMETRY.words - 1}

All {holding.ODOMETRY.words} registers in one request (function 16), at a steady rate of 10 per second or more.

{table(head, _holding_rows(holding.ODOMETRY, holding.ODOMETRY_ADDRESS))}
"""


def _limits() -> str:
    rows = [
        ("registers in one read", str(requests.MAX_READ), "exception 3"),
        ("registers in one write", str(requests.MAX_WRITE), "exception 3"),
        ("address outside the tables", "", "exception 2"),
        ("any other function", "", "exception 1"),
        ("TCP connections", str(modbus.MAX_CONNECTIONS),
         f"the longest idle is dropped if idle for {modbus.EVICT_S:g} s, else the new one"),
        ("TCP without a request", f"{modbus.IDLE_S:g} s", "closed"),
        ("TCP request not completed", f"{modbus.PARTIAL_S:g} s", "closed"),
        ("TCP answers not read", f"{modbus.STUCK_S:g} s", "closed"),
        ("what is not Modbus", "", "UDP: ignored and counted; TCP: closed"),
    ]  # fmt: skip
    return table(("what", "limit", "beyond it"), rows)


def udp_page() -> str:
    """The text of `docs/udp.md`."""
    crc = registers.DATAGRAM_SIZE - 4
    rows = [
        ("0", "`magic`", "4 bytes", "", "", f'"{registers.DATAGRAM_MAGIC.decode()}".'),
        ("4", "`version`", "uint16", "", "", f"{registers.VERSION}."),
        ("6", "`length`", "uint16", "", "", f"Bytes of the whole datagram, {registers.DATAGRAM_SIZE} or more; "
         f"{registers.SMALLEST_DATAGRAM} from programs that knew no lights, which sent no more than `devices`; "
         f"{registers.TRUST_OFFSET + 4} from those that sent no more than `light_age`."),
        *_rows(registers.BODY, registers.BODY_OFFSET, 2),
        *_rows(lights.TAIL, registers.TAIL_OFFSET, 2),
        *_rows(integrity.TAIL, registers.TRUST_OFFSET, 2),
        ("length - 4", "`crc`", "uint32", "", "", f"CRC-32 of all bytes before it (at {crc} in this version)."),
    ]  # fmt: skip
    return f"""{_NOTICE}
# UDP

## Pose datagrams

After each cycle the daemon sends one datagram to every `pose.receivers` entry (`host:port`). Little-endian, every value
naturally aligned, CRC-32 as in zlib and IEEE 802.3. Nothing is repeated: a lost datagram is followed by a newer one.
Readers go by `length`: a later version of the program may append values under the same `version` number. A reference
reader in C is `tools/clients/listen_pose.c`.

{_NOT_KNOWN}

{table(("byte", "name", "type", "step", "not known", "meaning"), rows)}

States, reasons, faults, the numbers of `light_fix` and the bits of `flags`, `devices` and `witnesses` are those of
[Modbus](modbus.md), where every single link can be read too.

## Odometry and IMU datagrams

With `odometry.port` set, the daemon takes wheel odometry and gyro readings as datagrams on that port. Little-endian,
CRC-32 as above. A reference sender is `tools/clients/send_odometry.py`.

{table(("byte", "type", "meaning"), _input_rows())}

* Odometry is cumulative, so a lost datagram loses nothing; one that was overtaken is dropped, and so is a repeated one.
* A sender that restarts draws a new `session` (or is silent for {inputs.SESSION_TIMEOUT_S:g} s) and may begin again
  at pose 0: the daemon carries on without a jump. While one sender is heard, another session on the port is ignored
  and counted.
* The time of a reading is the kernel's time of arrival. A sender on the same computer does better: it sets bit 0 of
  `flags` and puts CLOCK_MONOTONIC into `time`; a time in the future or more than {inputs.MAX_AGE_S:g} s old is not
  believed.
* Values that are not finite or beyond {input_codec.LARGEST:g}, a wrong length or a wrong CRC are dropped and counted.
"""


def _input_rows() -> list[tuple[str, ...]]:
    return [
        ("0", "4 bytes", '`magic`: "LUOD" odometry, "LUIM" IMU.'),
        ("4", "uint16", f"`version`: {input_codec.VERSION}."),
        (
            "6",
            "uint16",
            f"`length` of the whole datagram: {input_codec.ODOMETRY_SIZE} odometry, {input_codec.IMU_SIZE} IMU.",
        ),
        ("8", "uint32", "`session`: a random number drawn when the sender starts."),
        ("12", "uint32", "`seq`: one more with every datagram of this kind, wraps."),
        ("16", "uint32", "`flags`: bit 0: `time` is CLOCK_MONOTONIC of the daemon's own computer."),
        ("20", "uint32", "0."),
        ("24", "float64", "`time` of the reading in seconds, in the sender's clock."),
        ("32", "float64", "Odometry: `x`, m. IMU: `yaw_rate`, rad/s, counter-clockwise."),
        ("40", "float64", "Odometry: `y`, m."),
        ("48", "float64", "Odometry: `yaw`, rad, counter-clockwise, wrapped or not."),
        ("length - 4", "uint32", "`crc`."),
    ]


def pages() -> dict[str, str]:
    """File name and text of every page."""
    return {"modbus.md": modbus_page(), "udp.md": udp_page()}


def write(folder: Path) -> None:
    """Write all pages into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / name).write_text(text)


if __name__ == "__main__":
    write(Path(sys.argv[1] if len(sys.argv) > 1 else "docs"))
