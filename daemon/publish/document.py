"""Generator of `codes.md`, `modbus.md` and `udp.md` from the tables: `python -m daemon.publish.document [FOLDER]`."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from daemon.health.faults import FAULTS
from daemon.health.reasons import REASONS
from daemon.publish.document_tables import NOT_KNOWN, NOTICE, bit_rows, holding_rows, layout_rows, order_lines, table
from daemon.publish.document_udp import udp_page
from daemon.publish.meanings import COMMANDS, FIXES, LOOPS, STATES, USES
from daemon.publish.modbus import (
    counts,
    dimmed_block,
    holding,
    integrity_block,
    lights_block,
    parts_block,
    registers,
    requests,
    tcp_endpoint,
    timing_block,
)
from daemon.publish.modbus.block import Block
from daemon.publish.modbus.holding import CommandCode
from daemon.publish.modbus.rtu import PATIENCE_S, SILENCE_S
from daemon.snapshot import LISTED_DIMMED, LISTED_LINKS, LightFix, LinkUse, LoopReason, State


def _state_rows() -> list[tuple[str, ...]]:
    return [(str(state.value), state.name, STATES[state]) for state in State]


def _meaning_rows(meanings: Mapping[Any, tuple[str, str]]) -> list[tuple[str, ...]]:
    return [(str(int(number)), text, remedy) for number, (text, remedy) in meanings.items()]


def codes_page() -> str:
    """The text of `docs/codes.md`."""
    return f"""{NOTICE}
# States, reasons, faults

`state`, `reason` and `fault` have the same numbers in Modbus, datagrams, the local stream and the log. A number never
changes its meaning and is never used again. `lumiloop explain fault 302` prints the same text.

The state says what the pose is worth. The reason says why the state is not better. A fault is a defect of a device, of
its data or of the program; several can be present at once. What you see of each fault, and how soon:
[measured](faults.md).

## States

{table(("number", "state", "meaning"), _state_rows())}

## Reasons

{table(("number", "reason", "what to do"), _meaning_rows(REASONS))}

## Faults

{table(("number", "fault", "what to do"), _meaning_rows(FAULTS))}
"""


def _bits() -> str:
    return f"""## Bits of `flags`

{table(("bit", "name", "set when"), bit_rows(registers.FLAGS))}

## Bits of `devices`

{table(("bit", "name", "set when"), bit_rows(registers.DEVICES))}
"""


def _span(block: Block) -> tuple[int, int]:
    return block.address, block.address + block.registers - 1


def _whole(block: Block, rows: Sequence[tuple[str, ...]] = ()) -> str:
    """Markdown table of a block from its magic to its end; `rows` replace its points where they repeat."""
    first, last = _span(block)
    tag = block.magic.to_bytes(2, "big").decode()
    return table(
        ("address", "name", "type", "step", "not known", "meaning"),
        [
            (str(first), "`magic`", "uint16", "", "", f'0x{block.magic:04X} ("{tag}").'),
            (str(first + 1), "`version`", "uint16", "", "", f"Version of this table: {block.version}."),
            *(rows or layout_rows(block, block.body, 1)),
            (str(last - 1), "`seq_end`", "uint32", "", "", "The same as `seq`: the block was read whole."),
        ],
    )


def modbus_page() -> str:
    """The text of `docs/modbus.md`."""
    end = registers.BLOCK_WORDS - 2
    block = [
        ("0", "`magic`", "uint16", "", "", f"0x{registers.MODBUS_MAGIC:04X} (\"LL\")."),
        ("1", "`version`", "uint16", "", "", f"Version of this table: {registers.VERSION}."),
        *layout_rows(registers.BODY, registers.BODY_ADDRESS, 1),
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
    return f"""{NOTICE}
# Modbus registers

The daemon is a Modbus server on UDP and TCP: port 1502 (`modbus.port`), on the loopback address unless `bind` is set.
With `modbus.serial` it also answers on a serial line (RTU). All show the same tables. It is not a safety function.

Read **{registers.BLOCK_WORDS} input registers from address 0 in one request** (function 4, or 3). The answer is one
whole snapshot of the last cycle.

| You need | Input registers |
| --- | --- |
| health: state, reason, most severe fault, `flags` | 4 to 7 |
| heartbeat | 8 |
| position and heading in the map | 18 to 23; as float32: {_mirrored("map_x", "map_yaw")} |
| the same, predicted to the time of sending | 24 to 29; as float32: {_mirrored("predicted_x", "predicted_yaw")} |
| sigma of the pose | 36 to 38; as float32: {_mirrored("sigma_x", "sigma_yaw")} |
| identity of the map | 46 |
| lamps in view | from {lights_block.BLOCK.address} |
| bound on the position error, alert limit | from {integrity_block.BLOCK.address} |
| all faults, uptime | from {parts_block.BLOCK.address} |
| commands, written | from {holding.COMMAND_ADDRESS} |

* Addresses count from 0. Tools that count from 1 show address 0 as 30001 (function 4) or 40001.
* The high byte comes first, and the **high word first** in 32- and 64-bit values.
* On UDP and TCP the daemon answers any unit identifier, on a serial line only its own.
* Over UDP one datagram is one request. Repeat it when no answer comes.
* Function 43 with MEI type 14 (read device identification) names program, version and, as user application name, the
  robot: regular objects 0 to 6, by stream or each alone.
* Check `magic` and `version` once. A register map never changes under the same `version`.
* Two requests may see two snapshots: compare `seq` with `seq_end`.
* Modbus has no password. Keep the port on a network you trust. `allow` names the addresses and networks that the daemon
  answers; it always answers this computer.
* Watch `heartbeat`: it stops when the daemon's cycle stops. Use the pose only in a `state` that your machine accepts.

{NOT_KNOWN}

## The block: input registers 0 to {registers.BLOCK_WORDS - 1}

{table(("address", "name", "type", "step", "not known", "meaning"), block)}

`state`, `reason` and `fault`: [States, reasons, faults](codes.md).

{_bits()}
## Float mirror: input registers {first} to {last + 1}

The same values as IEEE 754 float32 in SI units, and the full covariance of the map pose. NaN means not known.

{table(("address", "name", "type", "unit", "meaning"), mirror)}

{_lights()}
{_integrity()}
{_pulse()}
{_parts()}
{_dimmed()}
{_writing()}
{_serial()}
## Limits

{_limits()}
"""


def _serial() -> str:
    return f"""## Serial line (RTU)

`modbus.serial = "/dev/ttyUSB1@115200#1"` names the line, its rate and the daemon's unit. The default rate is 19200
bit/s. Characters have 8 bits, even parity and one stop bit. Another format follows the rate: `@9600,8N1` (8E1, 8O1,
8N1, 8N2). A pseudo-terminal (socat, a gateway) takes 8N1 only.

An answer starts 3.5 characters after its request at the earliest. The daemon drops a request that pauses for more than
{1e3 * SILENCE_S:g} ms. It carries out a request to unit 0 and does not answer it. Adapters that echo work.

Let the master wait for half a second or more. A request that cannot be served within {1e3 * PATIENCE_S:g} ms, or that
the next one overtakes, is neither carried out nor answered. So a request without an answer had no effect, or its answer
was lost: repeat it.

A reference client is `tools/clients/read_rtu.py`. To try the line from the other end:
`mbpoll -m rtu -a 1 -b 115200 -P even -t 3 -0 -r 0 -c 64 /dev/ttyUSB0`. The same over the network:
`mbpoll -m tcp -p 1502 -t 3 -0 -r 0 -c 64 HOST`.
"""


def _lights() -> str:
    first, last = _span(block := lights_block.BLOCK)
    every = layout_rows(block, block.body, 1)
    head = [row for row in every if not row[1].startswith("`link_")]
    one = [row for row in every if row[1].startswith("`link_1_")]
    start, width = block.body + block.offsets[len(head)], lights_block.ROW_WORDS
    words, links = block.registers, LISTED_LINKS
    return f"""## Lights: input registers {first} to {last}

The lamps in view and the position from light alone, which never depends on the lidar. Read **{words} registers from
address {first} in one request**. There are {links} links, the strongest first. Link k
begins at {start} + {width} (k - 1); the table shows the first.

{_whole(block, [*head, *one])}

{table(("`light_fix`", "name", "meaning"), [(str(fix.value), fix.name, FIXES[fix]) for fix in LightFix])}

{table(("`link_..._use`", "name", "meaning"), [(str(use.value), use.name, USES[use]) for use in LinkUse])}
"""


def _integrity() -> str:
    first, last = _span(block := integrity_block.BLOCK)
    return f"""## Integrity: input registers {first} to {last}

How far the pose can be trusted. [Integrity](integrity.md) defines the protection level and its risk. Read
**{block.registers} registers from address {first} in one request**.

{_whole(block)}

{table(("bit of `witnesses`", "name", "set when"), bit_rows(integrity_block.WITNESSES))}

{table(("`loop_reason`", "name", "meaning"), [(str(why.value), why.name, LOOPS[why]) for why in LoopReason])}
"""


def _pulse() -> str:
    first, last = _span(block := timing_block.BLOCK)
    return f"""## The cycle: input registers {first} to {last}

What the daemon leaves out on a slow computer, how long each stage of a cycle takes, and when cycles stopped
([the cycle](cycle.md)). Medians and percentiles cover the last half minute to minute. Read **{block.registers}
registers from address {first} in one request**.

{_whole(block)}
"""


def _parts() -> str:
    first, last = _span(block := parts_block.BLOCK)
    return f"""## The parts: input registers {first} to {last}

All present faults, the restarts of each part, and the uptime. An uptime that begins again shows a restart. Read
**{block.registers} registers from address {first} in one request**. The daemon looks for faults once a second.

{_whole(block)}

{table(("bit of `hanging`", "name", "what hangs, and what then"), _thread_rows())}
"""


def _dimmed() -> str:
    first, last = _span(block := dimmed_block.BLOCK)
    every = layout_rows(block, block.body, 1)
    lamps = [row for row in every if row[1].startswith("`dimmed_")]
    one, head = lamps[: len(lamps) // LISTED_DIMMED], every[: -len(lamps)]
    first_lamp, second_lamp = (int(lamps[k][0]) for k in (0, len(one)))
    return f"""## Dimmed lamps: input registers {first} to {last}

PWM-dimmed lamps in view ([Receiver](receiver.md#dimmed-lamps-and-other-light)). Read **{block.registers} registers from
address {first} in one request**. Lamp k of {LISTED_DIMMED} begins at {first_lamp} + {second_lamp - first_lamp} (k - 1).

{_whole(block, [*head, *one])}
"""


def _thread_rows() -> list[tuple[str, ...]]:
    return [(str(thread.value), thread.name, f"{text}.") for thread, text in parts_block.THREADS.items()]


def _mirrored(first: str, last: str) -> str:
    """Addresses of some values in the float mirror."""
    names = [point.name for point in registers.MIRROR]
    begin = registers.MIRROR_ADDRESS + 2
    return f"{begin + 2 * names.index(first)} to {begin + 2 * names.index(last) + 1}"


def _capital(text: str) -> str:
    return f"{text[0].upper()}{text[1:]}."


def _command_rows() -> list[tuple[str, ...]]:
    return [(str(code.value), code.name, COMMANDS[code]) for code in CommandCode]


def _writing() -> str:
    head = ("address", "name", "type", "access", "step", "not known", "meaning")
    return f"""## Writing: holding registers

Writing needs `modbus.write = true`; otherwise every write gets exception 1. Functions 6, 16 and 23 write, function 3
reads back. Function 23 writes first, then reads any of the tables; where either is impossible, it writes nothing.
Everybody who is answered can write. Examples: [Control a running daemon](control.md).

### Command block, {holding.COMMAND_ADDRESS} to {holding.COMMAND_ADDRESS + holding.COMMAND.words - 1}

Write `command`, its parameters, and a new number into `request`: all in one request, or `request` last. The command is
finished when `acknowledge` equals that number. `result` then tells how it ended. The same number again does nothing, so
a repeated UDP datagram does no harm. A newer request replaces one that still runs. A reference client is
`tools/clients/send_command.py`.

{table(("`command`", "name", "what happens"), _command_rows())}

{table(head, holding_rows(holding.COMMAND, holding.COMMAND_ADDRESS))}

`lumiloop set-pose` and its like write these registers and wait for the result ([control](control.md)). With `mbpoll`
each command is one line. `-0` counts addresses from 0, as this page does. The first of the two last numbers is the
request number: use a new one each time.

{order_lines()}

### Loop acknowledge, {holding.LOOP_ADDRESS}

The bit `loop_latched` of `flags` stays set from a loop closure until a client writes its `loop_counter` here. So a
client that reads seldom misses none. All clients share one latch: where there are several, each compares
`loop_counter` itself.

{table(head, holding_rows(holding.LOOP, holding.LOOP_ADDRESS))}

### Odometry input, {holding.ODOMETRY_ADDRESS} to {holding.ODOMETRY_ADDRESS + holding.ODOMETRY.words - 1}

Write all {holding.ODOMETRY.words} registers in one request (function 16), ten times a second or more. Over UDP the time
of the reading is the kernel's time of arrival less `age`. Over TCP and on a serial line it is the time when the daemon
reads it.

{table(head, holding_rows(holding.ODOMETRY, holding.ODOMETRY_ADDRESS))}
"""


def _limits() -> str:
    rows = [
        ("registers in one read", str(requests.MAX_READ), "exception 3"),
        ("registers in one write", str(requests.MAX_WRITE), "exception 3"),
        ("registers written in one request that reads too", str(requests.MAX_READ_WRITE), "exception 3"),
        ("address outside the tables", "", "exception 2"),
        ("any other function", "", "exception 1"),
        ("an internal error, which is in the log", "", "exception 4"),
        ("TCP connections", str(counts.MAX_CONNECTIONS),
         f"the longest idle is dropped if idle for {tcp_endpoint.EVICT_S:g} s, else one of the host with the most, if "
         "that has more than the new one's, else the new one"),
        ("TCP connections of one host", str(counts.PER_HOST),
         f"its longest idle is dropped if idle for {tcp_endpoint.EVICT_S:g} s, else the new one; an IPv6 /64 network "
         "is one host"),
        ("TCP without a request", f"{tcp_endpoint.IDLE_S:g} s", "closed"),
        ("TCP request not completed", f"{tcp_endpoint.PARTIAL_S:g} s", "closed"),
        ("TCP answers not read", f"{tcp_endpoint.STUCK_S:g} s", "closed"),
        ("data that is not Modbus", "", "UDP: ignored; TCP: closed; the log names the sender once a minute"),
    ]  # fmt: skip
    return table(("what", "limit", "beyond it"), rows)


def pages() -> dict[str, str]:
    """File name and text of every page."""
    return {"codes.md": codes_page(), "modbus.md": modbus_page(), "udp.md": udp_page()}


def write(folder: Path) -> None:
    """Write all pages into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in pages().items():
        (folder / name).write_text(text)


def main() -> None:
    """Command-line entry point."""
    parser = argparse.ArgumentParser(
        prog="python -m daemon.publish.document", description=f"Write {', '.join(pages())} from the daemon's tables."
    )
    parser.add_argument("folder", nargs="?", type=Path, default=Path("docs"), help="where to; docs, unless given")
    write(parser.parse_args().folder)


if __name__ == "__main__":
    main()
