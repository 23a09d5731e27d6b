"""`lumiloop status`: read a running daemon over Modbus UDP and show it to a person or, as JSON, to a program.

Standard library only, so that it starts at once on any computer.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import shutil
import socket
import struct
import sys
import time
from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import TYPE_CHECKING, Any, Final

from daemon.publish.modbus import integrity_block, lights_block, parts_block, registers, timing_block
from daemon.publish.modbus.block import Block
from daemon.publish.modbus.points import U16, Value
from daemon.publish.modbus.requests import BLOCKS
from daemon.publish.port_owner import Whose, whose
from daemon.snapshot import GUESSED, LISTED_LINKS, LightFix, LinkUse, Stage, State

if TYPE_CHECKING:
    from daemon.config.schema import Config

OK: Final = 0
FAILED: Final = 1
DEFAULT_PORT: Final = 1502
_TRIES: Final = 3
_TIMEOUT_S: Final = 0.5
_STALL_S: Final = 0.4  # the slowest lidar makes a snapshot every 0.15 s
_REFRESH_S: Final = 0.5
_REQUEST: Final = struct.Struct(">HHHBBHH")
_ANSWER: Final = struct.Struct(">HHHBBB")
_READ_INPUT: Final = 4
_ANY_HOST: Final = {"": "127.0.0.1", "0.0.0.0": "127.0.0.1", "::": "::1"}
_TOP: Final = U16.span[1] / 10_000  # where ages and sigmas, 16 bits of 0.1 ms or 0.1 mm, saturate
_GUESS: Final = "  (a guess: the place is not known)"
_CLEAR: Final = "\x1b[H\x1b[2J"

Reading = dict[str, Value]


class NoAnswer(Exception):
    """The daemon cannot be read; the text says why and what to do."""


class Reader:
    """Reads the published block of one daemon. Use as a context manager.

    Args:
        host: name or address.
        port: of it.
        name: of the daemon that is meant, on this computer; None: whichever answers.

    Raises:
        NoAnswer: the host's name is not known.
    """

    def __init__(self, host: str, port: int, name: str | None = None) -> None:
        self._where = f"{host}:{port}"
        self._name = name
        self._transaction = 0
        try:
            family, kind, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
            self._sock = socket.socket(family, kind)
            self._sock.connect(address)
        except UnicodeError as error:
            raise NoAnswer(f"{self._where}: not a host name; check the address") from error
        except OSError as error:
            raise NoAnswer(f"{self._where}: {error.strerror or error}; check the address") from error
        self._sock.settimeout(_TIMEOUT_S)

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, *_: object) -> None:
        self._sock.close()

    def whose(self) -> Whose:
        """Who answers.

        Raises:
            NoAnswer: another daemon than the one that is meant, and that one runs, too.
        """
        if self._name is None:
            return Whose(0, "", 0)
        found = whose(self._name, *self._sock.getpeername()[:2])
        if found.another:
            raise NoAnswer(
                f"{self._where} is answered by {found}, not by `{self._name}` (process {found.meant}), which cannot "
                f"have the port: give one of them another modbus.port; `lumiloop status {self._where}` shows that one"
            )
        return found

    def read(self) -> Reading:
        """The latest snapshot.

        Raises:
            NoAnswer: nothing there, not a lumiloop, another version.
        """
        for _ in range(_TRIES):
            try:
                answer = self._ask(0, registers.BLOCK_WORDS)
            except TimeoutError:
                continue
            except OSError as error:
                raise NoAnswer(
                    f"{self._where}: {error.strerror}; nothing serves Modbus there: start `lumiloop run`, or name the "
                    "right HOST:PORT"
                ) from error
            reading = self._reading(answer)
            for block in BLOCKS:
                if block is not lights_block.BLOCK or reading["links"] is not None:
                    reading |= self._block(block)
            return reading
        raise NoAnswer(
            f"{self._where}: no answer within {_TRIES * _TIMEOUT_S:g} s; check that the daemon runs, that its `bind` "
            "is not the loopback address of another computer, and that no firewall drops UDP"
        )

    def _block(self, block: Block) -> Reading:
        """A block beside the first one; nothing where the daemon is of a version without it."""
        for _ in range(_TRIES):
            with contextlib.suppress(OSError):
                answer = self._ask(block.address, block.registers)
                if len(answer) == _ANSWER.size and answer[7] & 0x80:
                    return {}  # no such block
                with contextlib.suppress(ValueError):
                    reading = block.decode(answer[_ANSWER.size :])
                    del reading["seq"]
                    return reading
        return {}

    def _ask(self, address: int, count: int) -> bytes:
        self._transaction = self._transaction % 0xFFFF + 1
        self._sock.send(_REQUEST.pack(self._transaction, 0, 6, 1, _READ_INPUT, address, count))
        deadline = time.monotonic() + _TIMEOUT_S
        while time.monotonic() < deadline:
            answer = self._sock.recv(512)
            if answer[:2] == self._transaction.to_bytes(2, "big"):
                return answer  # an answer to an earlier, repeated request is skipped
        raise TimeoutError

    def _reading(self, answer: bytes) -> Reading:
        if len(answer) == _ANSWER.size and answer[7] & 0x80:
            raise NoAnswer(f"{self._where}: Modbus exception {answer[8]}; that is another kind of device")
        try:
            return registers.decode_block(answer[_ANSWER.size :])
        except ValueError as error:
            raise NoAnswer(f"{self._where}: {error}") from error


def main(args: argparse.Namespace) -> int:
    """Body of the command; `args` has address, json, watch, and settings (:class:`daemon.config.schema.Config`)."""
    try:
        host, port = address_of(args.address, args.settings)
        with Reader(host, port, None if args.address or args.settings is None else args.settings.name) as reader:
            return _watch(reader, args.json) if args.watch else _once(reader, args.json)
    except NoAnswer as error:
        sys.stderr.write(f"lumiloop: {error}\n")
        return FAILED


def address_of(text: str | None, settings: Config | None) -> tuple[str, int]:
    """Host and port to read: as named, else where the configuration says that the daemon listens.

    Raises:
        NoAnswer: not an address.
    """
    if not text:
        host, port = (settings.bind, settings.modbus.port) if settings is not None else ("127.0.0.1", DEFAULT_PORT)
        if port == 0:
            raise NoAnswer("the configuration switches Modbus off (modbus.port is 0); name HOST:PORT")
        return _ANY_HOST.get(host, host), port
    host, colon, port_text = text.rpartition(":")
    if text.startswith("[") and text.endswith("]"):
        return text[1:-1], DEFAULT_PORT
    if not colon or (":" in host and not host.startswith("[")):
        return text, DEFAULT_PORT
    if not (port_text.isascii() and port_text.isdigit() and 0 < int(port_text) < 1 << 16):
        raise NoAnswer(f"{text}: {port_text!r} is not a port; write HOST or HOST:PORT, as in 192.168.0.10:1502")
    return host.strip("[]") or "127.0.0.1", int(port_text)


def _once(reader: Reader, as_json: bool) -> int:
    first = reader.read()
    who = reader.whose()
    time.sleep(_STALL_S)
    reading = reader.read()
    _show(reading, as_json, reading["seq"] == first["seq"], who)
    return OK


def _watch(reader: Reader, as_json: bool) -> int:
    before: Value = None
    who, told = None, ""
    while True:
        try:
            reading = reader.read()
            who = reader.whose() if before is None or who is None else who
        except NoAnswer as error:
            if str(error) != told:
                sys.stderr.write(f"lumiloop: {error}; waiting\n")
            before, told = None, str(error)
        else:
            told = ""
            on_screen = sys.stdout.isatty() and not as_json
            _show(reading, as_json, reading["seq"] == before, who, on_screen)
            before = reading["seq"]
        time.sleep(_REFRESH_S)


def _show(reading: Reading, as_json: bool, stalled: bool, who: Whose, on_screen: bool = False) -> None:
    if as_json:
        text = json.dumps(as_object(reading, stalled) | {"process": who.pid or None})
    else:
        text = (f"{'daemon':<10} {who}\n" if who.pid else "") + as_table(reading, stalled)
    sys.stdout.write((_CLEAR + _fitted(text) if on_screen else text) + "\n")
    sys.stdout.flush()


def _fitted(text: str) -> str:
    """What a terminal has room for: the state, which stands first, is not to scroll away."""
    size = shutil.get_terminal_size()
    lines, room = [line[: size.columns] for line in text.splitlines()], max(2, size.lines - 1)
    if len(lines) > room:
        lines[room - 1 :] = [f"... {len(lines) - room + 1} more lines: a higher window"[: size.columns]]
    return "\n".join(lines)


def as_object(reading: Reading, stalled: bool) -> dict[str, Any]:
    """The reading with its codes and bits spelled out."""
    spelled = {
        "state": _state(reading["state"]),
        "reason_text": _meaning("reason", reading["reason"]),
        "fault_text": _meaning("fault", reading["fault"]),
        "flags": registers.decode_bits(registers.FLAGS, reading["flags"]),
        "devices": registers.decode_bits(registers.DEVICES, reading["devices"]),
        "stalled": stalled,
    }
    if "witnesses" in reading:
        spelled |= {"witnesses": registers.decode_bits(integrity_block.WITNESSES, reading["witnesses"])}
    if "light_fix" in reading:
        spelled |= {"light_fix": _fix(reading), "light_links": [dict(link) for link in _links(reading)]}
    return {key: value for key, value in reading.items() if not key.startswith("link_")} | spelled


def _fix(reading: Reading) -> str | None:
    number = reading["light_fix"]
    return None if number is None else _name(LightFix, number)


def _links(reading: Reading) -> Iterator[dict[str, Any]]:
    """Every link in view, strongest first."""
    for row in range(1, LISTED_LINKS + 1):
        if (code := reading[f"link_{row}_code"]) is not None:
            link = {name: reading[f"link_{row}_{name}"] for name in ("lamp", "use", "strength", "residual")}
            yield {"code": code, **link, "use": _name(LinkUse, link["use"])}


def as_table(reading: Reading, stalled: bool) -> str:
    """The reading for a person: one line a subject."""
    flags = registers.decode_bits(registers.FLAGS, reading["flags"])
    starting = reading["state"] == State.STARTING  # no cycle yet: nothing is published anew, no device judged
    still = "  (STANDS STILL: no new snapshot)" if stalled and not starting else ""
    rows = [
        ("state", _state(reading["state"]) + still),
        ("reason", _meaning("reason", reading["reason"])),
        ("fault", _meaning("fault", reading["fault"])),
        *_more_faults(reading),
        ("map pose", _pose(reading, "map") + _reserve(reading["state"], flags)),
        ("sigma", _triple(reading, ("sigma_x", "sigma_y", "sigma_yaw"), "m", "")),
        *_trust(reading),
        ("odom pose", _pose(reading, "odom")),
        ("speed", _triple(reading, ("v_x", "v_y", "yaw_rate"), "m/s", "/s")),
        ("age", _bounded(reading["age"], "s")),
        ("map", f"id {reading['map_id']:08x}, {reading['jumps']} jumps"),
        ("loops", _loops(reading)),
        *_lights(reading),
        ("scans", f"{_number(reading['scan_rate'], 'Hz', 2)}, {reading['missed']} missed"),
        ("cycle", f"{_number(reading['cycle'], 's', 5)}, {reading['overruns']} over budget{_left_out(reading)}"),
        ("devices", _devices(reading["devices"], starting)),
        *_parts(reading),
        ("snapshot", f"{reading['seq']}, {_date(reading['t_utc'])}"),
    ]
    return "\n".join(f"{label:<10} {text}".rstrip() for label, text in rows)


def _more_faults(reading: Reading) -> list[tuple[str, str]]:
    """Faults beside the gravest."""
    numbers = [reading.get(f"fault_{k}") for k in range(2, parts_block.FAULTS + 1)]
    return [("", _meaning("fault", number)) for number in numbers if number]


def _parts(reading: Reading) -> list[tuple[str, str]]:
    """For how long it runs, what had to be restarted, what is down or hangs."""
    if "uptime" not in reading:
        return []
    counts = {part.name: reading[f"restarts_{part.name.lower()}"] for part in parts_block.PARTS}
    restarted = ", ".join(f"{name} {count:g}" for name, count in counts.items() if count)
    said = f"{reading['uptime']:g} s" + (f"; restarted: {restarted}" if restarted else "")
    for word, table in (("down", parts_block.PARTS), ("hanging", parts_block.THREADS)):
        names = [member.name for member in table if int(reading[word] or 0) >> member & 1]
        said += f"; {word}: {', '.join(names)}" if names else ""
    return [("running", said)]


def _state(number: Value) -> str:
    return _name(State, number)


def _name(table: type[IntEnum], number: Value) -> str:
    try:
        return table(int(number or 0)).name
    except ValueError:
        return f"unknown to this reader ({number})"


def _meaning(subject: str, number: Value) -> str:
    """What a reason or fault number means and what to do; the tables are loaded only when there is one to explain."""
    if not number:
        return "none"
    from daemon.health.faults import FAULTS
    from daemon.health.reasons import REASONS

    meanings: Mapping[Any, tuple[str, str]] = REASONS if subject == "reason" else FAULTS
    text, remedy = meanings.get(int(number), ("unknown to this reader", "use the daemon's own version of this command"))
    return f"{number}: {text}" + (f" ({remedy})" if remedy else "")


def _number(value: Value, unit: str, digits: int = 4) -> str:
    return "not known" if value is None else f"{value:.{digits}f} {unit}"


def _bounded(value: Value, unit: str) -> str:
    """An age, a sigma or a speed; a register at its largest value says that much or more.

    Speeds have a coarser step and never read as just that.
    """
    return f"> {math.floor(10.0 * _TOP) / 10.0} {unit}" if value is not None and value >= _TOP else _number(value, unit)


def _angle(value: Value) -> str:
    return "not known" if value is None else f"{math.degrees(value):.2f} deg"


def _triple(reading: Reading, names: tuple[str, str, str], unit: str, per: str) -> str:
    x, y, yaw = (reading[name] for name in names)
    if x is None and y is None and yaw is None:
        return "not known"
    return f"{_bounded(x, unit)}, {_bounded(y, unit)}, {_angle(yaw)}{per}"


def _left_out(reading: Reading) -> str:
    """How long cycles take, what they leave out, and when they stood still, as far as it is known and worth a word."""
    long, rung, stalls = reading.get("cycle_p99"), int(reading.get("rung") or 0), reading.get("stalls")
    said = f", 99 of 100 within {_number(long, 's', 5)}" if long is not None else ""
    said += f"; {timing_block.RUNGS[rung]}" if 0 < rung < len(timing_block.RUNGS) else ""
    if not stalls:
        return said
    number = reading["stall_in"]
    where = "" if number is None else f" in {_name(Stage, number)}"
    return f"{said}; stood still {stalls:g} times, latest {_number(reading['stall'], 's', 3)}{where}"


def _trust(reading: Reading) -> list[tuple[str, str]]:
    """The bound on the error, what it rests on, and whether it is above the limit that is set."""
    if "witnesses" not in reading:
        return []
    bits = registers.decode_bits(integrity_block.WITNESSES, reading["witnesses"])
    if reading["protection"] is None:
        text = "none"
    else:
        names = {"laser_bounds": "laser", "light_bounds": "light", "wheels_bound": "wheels"}
        rests = ", ".join(name for bit, name in names.items() if bits[bit])
        text = f"{_number(reading['protection'], 'm', 3)}, {_angle(reading['protection_yaw'])} ({rests})"
    limit = reading["alert_limit"]
    alert = "" if limit is None else f"{'  ALERT' if bits['alert'] else ''}, limit {limit:.3f} m"
    places = reading["places"]
    return [("bound", text + alert), *([] if places is None else [("places", f"{places:g} fit")])]


def _lights(reading: Reading) -> list[tuple[str, str]]:
    """How many lamps, what lights alone say, and a line for every link."""
    if reading["links"] is None:
        return [("lights", "no photodiode configured")]
    strongest = reading["light_id"]
    rows = [("lights", f"{reading['links']} in view" + ("" if strongest is None else f", strongest lamp {strongest}"))]
    if "light_fix" not in reading:
        return rows
    names = ("light_sigma_x", "light_sigma_y", "light_sigma_yaw")
    rows.append(
        ("light fix", f"{_fix(reading)}, {reading['light_used']} used, age {_bounded(reading['light_age'], 's')}")
    )
    rows.append(("light pose", _pose(reading, "light")))
    rows.append(("", f"sigma {_triple(reading, names, 'm', '')}"))
    links = list(_links(reading))
    if links:
        rows.append(("links", f"{'lamp':>6} {'code':>5} {'strength':>12} {'residual':>9}  use"))
    for link in links:
        lamp = "-" if link["lamp"] is None else link["lamp"]
        residual = "-" if link["residual"] is None else f"{100.0 * math.expm1(link['residual']):+.1f} %"
        rows.append(("", f"{lamp:>6} {link['code']:>5} {1e9 * link['strength']:>9.2f} nA {residual:>9}  {link['use']}"))
    return rows


def _pose(reading: Reading, frame: str) -> str:
    if reading[f"{frame}_x"] is None:
        return "not known"
    x, y, yaw = (reading[f"{frame}_{axis}"] for axis in ("x", "y", "yaw"))
    return f"x {_number(x, 'm')}, y {_number(y, 'm')}, yaw {_angle(yaw)}"


def _unknown_axes(flags: dict[str, bool]) -> str:
    missing = [axis for axis in ("x", "y", "yaw") if not flags[f"{axis}_known"]]
    return f"  (not observed: {', '.join(missing)})" if flags["pose_valid"] and missing else ""


def _reserve(state: Value, flags: dict[str, bool]) -> str:
    """What has to be known of a pose before it is used."""
    return _GUESS if state in GUESSED and flags["pose_valid"] else _unknown_axes(flags)


def _loops(reading: Reading) -> str:
    if reading["loop_new"] is None:
        return f"{reading['loop_counter']}"
    fits = f", residual {_number(reading['loop_residual'], 'm')}" if reading.get("loop_residual") is not None else ""
    return f"{reading['loop_counter']}, latest: keyframe {reading['loop_new']} to {reading['loop_old']}{fits}"


def _devices(word: Value, starting: bool) -> str:
    bits = registers.decode_bits(registers.DEVICES, word)
    fitted = [name for name in ("lidar", "adc", "odometry") if bits[f"{name}_fitted"]]
    if starting and fitted:
        return f"{', '.join(fitted)}: told from the first cycle on"
    return ", ".join(f"{name} {'ok' if bits[f'{name}_ok'] else 'NOT OK'}" for name in fitted) or "none configured"


def _date(t_utc: Value) -> str:
    if not t_utc:
        return "no time"
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(t_utc))
