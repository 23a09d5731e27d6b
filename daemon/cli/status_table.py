"""Status as a table for the operator, from the published registers."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping
from enum import IntEnum
from typing import Any, Final

from daemon.publish.modbus import integrity_block, parts_block, registers, timing_block
from daemon.publish.modbus.client import Reading
from daemon.publish.modbus.points import U16, Value
from daemon.snapshot import GUESSED, LISTED_DIMMED, LISTED_LINKS, DimmedLamp, LightFix, LinkUse, Stage, State

_TOP: Final = U16.span[1] / 10_000  # where ages and sigmas, 16 bits of 0.1 ms or 0.1 mm, saturate
_GUESS: Final = "  (unconfirmed pose)"
WORDS: Final = {
    "map pose": "pose in the map frame: x and y in m, yaw counter-clockwise from the x axis",
    "sigma": "one standard deviation of x, y and yaw",
    "hypotheses": "number of poses that are possible during relocalisation",
    "lights": "number of lamps in view, and the lamp with the largest RSS",
    "light fix": "state of the light filter, number of lamps used, and age of the light",
    "lamp": "number of the lamp in the survey",
    "code": "number of the code that the lamp sends",
    "use": "use of the lamp; `lumiloop explain` with the shown word gives its meaning",
    "light pose": "light solution: the pose by light and odometry, without the lidar",
    "odom pose": "pose in the odom frame, which never jumps",
    "speed": "velocity in the base frame: ahead, to the left, and turning",
    "map": "identity of the map, and the number of jumps of the map pose",
    "loops": "number of loop closures, and the keyframes of the latest one",
    "scans": "valid scans per second, and missed scans since the start",
    "devices": "configured devices; NOT OK: the device delivers no valid data",
    "running": "time since the start of the daemon, and restarted, failed or hanging components",
    "snapshot": "number and time of the published snapshot",
    "STALLED": "no new snapshot arrives: the daemon or its cycle has stopped",
    "RSS": "received signal strength: amplitude of the modulated photocurrent of a lamp",
    "residual": "received RSS of a lamp minus the expected RSS, in percent of the expected RSS",
}
"""Words of the table that are no names of registers, with their meaning."""


def _fix(reading: Reading) -> str | None:
    number = reading["light_fix"]
    return None if number is None else _name(LightFix, number)


def _links(reading: Reading) -> Iterator[dict[str, Any]]:
    """Yields every listed link, largest RSS first."""
    for row in range(1, LISTED_LINKS + 1):
        if (code := reading[f"link_{row}_code"]) is not None:
            link = {name: reading[f"link_{row}_{name}"] for name in ("lamp", "use", "strength", "residual")}
            yield {"code": code, **link, "use": _name(LinkUse, link["use"])}


def _dimmed(reading: Reading) -> Iterator[DimmedLamp]:
    """Yields the PWM-dimmed lamps in view; none from a daemon of a version without their block."""
    for row in range(1, LISTED_DIMMED + 1):
        hertz, swing = reading.get(f"dimmed_{row}_frequency"), reading.get(f"dimmed_{row}_swing")
        if hertz is not None and swing is not None:
            yield DimmedLamp(hertz, swing, reading[f"dimmed_{row}_other"])


def as_table(reading: Reading, stalled: bool) -> str:
    """Returns the reading as a table: state, pose, faults and lamps first; one line a subject."""
    flags = registers.decode_bits(registers.FLAGS, reading["flags"])
    starting = reading["state"] == State.STARTING  # no cycle yet: there are no new snapshots, and devices have no state
    still = "  (STALLED: no new snapshot)" if stalled and not starting else ""
    rows = [
        ("state", _state(reading["state"]) + still),
        ("reason", _meaning("reason", reading["reason"])),
        ("map pose", _pose(reading, "map") + _reserve(reading["state"], flags)),
        ("sigma", _triple(reading, ("sigma_x", "sigma_y", "sigma_yaw"), "m", "")),
        *_trust(reading),
        ("fault", _meaning("fault", reading["fault"])),
        *_more_faults(reading),
        *_lights(reading),
        ("odom pose", _pose(reading, "odom")),
        ("speed", _triple(reading, ("v_x", "v_y", "yaw_rate"), "m/s", "/s")),
        ("age", _bounded(reading["age"], "s")),
        ("map", f"id {reading['map_id']:08x}, {reading['jumps']} jumps"),
        ("loops", _loops(reading)),
        ("scans", f"{_number(reading['scan_rate'], 'Hz', 2)}, {reading['missed']} missed"),
        ("cycle", f"{_number(reading['cycle'], 's', 5)}, {reading['overruns']} over budget{_left_out(reading)}"),
        ("devices", _devices(reading["devices"], starting)),
        *_parts(reading),
        ("snapshot", f"{reading['seq']}, {_date(reading['t_utc'])}"),
    ]
    return "\n".join(f"{label:<10} {text}".rstrip() for label, text in rows)


def _more_faults(reading: Reading) -> list[tuple[str, str]]:
    """Returns the rows of the faults beside the gravest; a consequence stands indented below its cause."""
    rows = []
    for fault, cause in list(_causes(reading).items())[1:]:
        said = _meaning("fault", fault)
        rows.append(("", f"  follows: {said.partition(' (')[0]}" if cause else said))
    return rows


def _causes(reading: Reading) -> dict[int, int]:
    """Returns the present faults in their published order, each with the fault that it follows from (0: none)."""
    numbers = [reading.get(f"fault_{k}") for k in range(1, parts_block.FAULTS + 1)]
    present = [int(number) for number in numbers if number]
    if not present:
        return {}
    from daemon.health.causes import cause_of

    return {fault: cause_of(fault, present) for fault in present}


def _parts(reading: Reading) -> list[tuple[str, str]]:
    """Returns the row of uptime, restarts, and components that are down or hang."""
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
        return f"unknown to this version ({number})"


def _meaning(subject: str, number: Value) -> str:
    """Returns meaning and remedy of a reason or fault number; the tables are loaded only when needed."""
    if not number:
        return "none"
    from daemon.health.faults import FAULTS
    from daemon.health.reasons import REASONS

    meanings: Mapping[Any, tuple[str, str]] = REASONS if subject == "reason" else FAULTS
    text, remedy = meanings.get(int(number), ("unknown to this version", "use the version of the daemon"))
    return f"{number}: {text}" + (f" ({remedy})" if remedy else "")


def _number(value: Value, unit: str, digits: int = 4) -> str:
    return "not known" if value is None else f"{value:.{digits}f} {unit}"


def _bounded(value: Value, unit: str) -> str:
    """Returns an age, a sigma or a speed; a register at its largest value means that value or more.

    Speeds have a coarser step and never read as exactly that value.
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
    """Returns cycle times, degradation level and stalls, where they are known and notable."""
    long, rung, stalls = reading.get("cycle_p99"), int(reading.get("rung") or 0), reading.get("stalls")
    said = f", 99 of 100 within {_number(long, 's', 5)}" if long is not None else ""
    said += f"; {timing_block.RUNGS[rung]}" if 0 < rung < len(timing_block.RUNGS) else ""
    if not stalls:
        return said
    number = reading["stall_in"]
    where = "" if number is None else f" in {_name(Stage, number)}"
    return f"{said}; {stalls:g} stalls, latest {_number(reading['stall'], 's', 3)}{where}"


def _trust(reading: Reading) -> list[tuple[str, str]]:
    """Returns the rows of the protection level, its solutions, the alert limit and the number of hypotheses."""
    if "witnesses" not in reading:
        return []
    bits = registers.decode_bits(integrity_block.WITNESSES, reading["witnesses"])
    if reading["protection"] is None:
        text = "none"
    else:
        names = {"laser_bounds": "lidar", "light_bounds": "light", "wheels_bound": "odometry"}
        rests = ", ".join(name for bit, name in names.items() if bits[bit])
        text = f"{_number(reading['protection'], 'm', 3)}, {_angle(reading['protection_yaw'])} ({rests})"
    limit = reading["alert_limit"]
    alert = "" if limit is None else f"{'  ALERT' if bits['alert'] else ''}, limit {limit:.3f} m"
    places = reading["places"]
    return [("protection", text + alert), *([] if places is None else [("hypotheses", f"{places:g}")])]


def _lights(reading: Reading) -> list[tuple[str, str]]:
    """Returns the rows of the lamps in view, the light solution, and every link."""
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
    rows += [("" if k else "dimmed", str(lamp)) for k, lamp in enumerate(_dimmed(reading))]
    links = list(_links(reading))
    if links:
        rows.append(("links", f"{'lamp':>6} {'code':>5} {'RSS':>12} {'residual':>9}  use"))
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
    """Returns what must be known of a pose before it is used."""
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
        return f"{', '.join(fitted)}: no data before the first cycle"
    return ", ".join(f"{name} {'ok' if bits[f'{name}_ok'] else 'NOT OK'}" for name in fitted) or "none configured"


def _date(t_utc: Value) -> str:
    if not t_utc:
        return "no time"
    return time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime(t_utc))
