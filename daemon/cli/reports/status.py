"""Report of `lumiloop status --json`."""

from __future__ import annotations

from typing import Any, Final

from daemon.cli.reports.output import meaning, name_of, pose, zoned
from daemon.publish.modbus import integrity_block, parts_block, registers, timing_block
from daemon.publish.modbus.client import Reading
from daemon.snapshot import LISTED_DIMMED, LISTED_LINKS, LightFix, LinkUse, LoopReason, Stage, State

AXES: Final = ("x", "y", "yaw")


def as_object(reading: Reading, stalled: bool, process: int = 0) -> dict[str, Any]:
    """Returns the reading as nested objects; None: not known. ``process``: that serves it, 0: not known."""
    return {
        "state": name_of(State, reading["state"]),
        "reason": meaning("reason", int(reading["reason"] or 0)),
        "faults": _faults(reading),
        "snapshot": {
            "seq": reading["seq"],
            "stalled": stalled,
            "time": zoned(reading["t_utc"]) if reading["t_utc"] else None,
            "t_mono_s": reading["t_mono"],
            "age_s": reading["age"],
        },
        "pose": {
            "map": _pose(reading, "map"),
            "predicted": _pose(reading, "predicted"),
            "odom": _pose(reading, "odom"),
            "sigma": _pose(reading, "sigma"),
            "correlation": {name: reading[f"rho_{name}"] for name in ("x_y", "x_yaw", "y_yaw")},
            "velocity": {
                "x_m_per_s": reading["v_x"],
                "y_m_per_s": reading["v_y"],
                "yaw_rad_per_s": reading["yaw_rate"],
            },
        },
        "flags": registers.decode_bits(registers.FLAGS, reading["flags"]),
        "devices": registers.decode_bits(registers.DEVICES, reading["devices"]),
        "map": {"id": f"{int(reading['map_id'] or 0):08x}", "jumps": reading["jumps"]},
        "loops": _loops(reading),
        "integrity": _integrity(reading),
        "lights": _lights(reading),
        "scans": {"rate_hz": reading["scan_rate"], "missed": reading["missed"]},
        "cycle": _cycle(reading),
        "daemon": _daemon(reading, process),
    }


def _faults(reading: Reading) -> list[dict[str, Any]]:
    """The present faults, the gravest first; ``cause``: number of the fault that one follows from, None: of none."""
    numbers = [reading["fault"], *(reading.get(f"fault_{k}") for k in range(2, parts_block.FAULTS + 1))]
    present = [int(number) for number in numbers if number]
    if not present:
        return []
    from daemon.health.causes import cause_of

    return [meaning("fault", fault) | {"cause": cause_of(fault, present) or None} for fault in present]


def _pose(reading: Reading, frame: str) -> dict[str, float] | None:
    return pose([reading[f"{frame}_{axis}"] for axis in AXES])


def _loops(reading: Reading) -> dict[str, Any]:
    return {
        "count": reading["loop_counter"],
        "latest": None
        if reading["loop_new"] is None
        else {
            "keyframe_new": reading["loop_new"],
            "keyframe_old": reading["loop_old"],
            "reason": name_of(LoopReason, reading.get("loop_reason")),
            "residual_m": reading.get("loop_residual"),
        },
    }


def _integrity(reading: Reading) -> dict[str, Any] | None:
    """The protection level and what it rests on; None: the daemon's version does not publish it."""
    if "witnesses" not in reading:
        return None
    return {
        "protection_m": reading["protection"],
        "protection_yaw_rad": reading["protection_yaw"],
        "alert_limit_m": reading["alert_limit"],
        "witnesses": registers.decode_bits(integrity_block.WITNESSES, reading["witnesses"]),
        "gap": reading["witness_gap"],
        "hypotheses": reading["places"],
    }


def _lights(reading: Reading) -> dict[str, Any] | None:
    """The light solution and every listed link, strongest first; None: no photodiode is configured."""
    if reading["links"] is None:
        return None
    found: dict[str, Any] = {"in_view": reading["links"], "strongest_lamp": reading["light_id"]}
    if "light_fix" not in reading:
        return found
    links = [_link(reading, row) for row in range(1, LISTED_LINKS + 1) if reading[f"link_{row}_code"] is not None]
    return found | {
        "fix": name_of(LightFix, reading["light_fix"]),
        "used": reading["light_used"],
        "pose": _pose(reading, "light"),
        "sigma": _pose(reading, "light_sigma"),
        "age_s": reading["light_age"],
        "floor_share": reading["light_floor"],
        "sample_clock_ppm": reading["sample_clock"],
        "blocks": reading["blocks"],
        "blocks_lost": reading["blocks_lost"],
        "links": links,
        "dimmed": _dimmed(reading),
    }


def _link(reading: Reading, row: int) -> dict[str, Any]:
    return {
        "code": reading[f"link_{row}_code"],
        "lamp": reading[f"link_{row}_lamp"],
        "use": name_of(LinkUse, reading[f"link_{row}_use"]),
        "strength_a": reading[f"link_{row}_strength"],
        "residual_ln": reading[f"link_{row}_residual"],
    }


def _dimmed(reading: Reading) -> list[dict[str, Any]]:
    """The PWM-dimmed lamps in view; none from a daemon of a version without their block."""
    return [
        {
            "frequency_hz": hertz,
            "other_frequency_hz": reading[f"dimmed_{row}_other"],
            "swing_a": reading[f"dimmed_{row}_swing"],
        }
        for row in range(1, LISTED_DIMMED + 1)
        if (hertz := reading.get(f"dimmed_{row}_frequency")) is not None
    ]


def _cycle(reading: Reading) -> dict[str, Any]:
    found: dict[str, Any] = {"latest_s": reading["cycle"], "overruns": reading["overruns"]}
    if "rung" not in reading:
        return found
    rung = int(reading["rung"] or 0)
    stages = [name.removesuffix("_p50") for name in reading if name.endswith("_p50")]
    return found | {
        "degradation": {"level": rung, "text": timing_block.RUNGS[rung] if rung < len(timing_block.RUNGS) else None},
        "thinned": reading["thinned"],
        "without_map": reading["without_map"],
        "carried": reading["carried"],
        "stalls": {
            "count": reading["stalls"],
            "latest_s": reading["stall"],
            "latest_in": name_of(Stage, reading["stall_in"]),
        },
        "stages": {
            name: {"median_s": reading[f"{name}_p50"], "p99_s": reading[f"{name}_p99"], "max_s": reading[f"{name}_max"]}
            for name in stages
        },
    }


def _daemon(reading: Reading, process: int) -> dict[str, Any]:
    found: dict[str, Any] = {"process": process or None}
    if "uptime" not in reading:
        return found
    counts = {part.name.lower(): reading[f"restarts_{part.name.lower()}"] for part in parts_block.PARTS}
    present = {
        word: [member.name.lower() for member in table if int(reading[word] or 0) >> member & 1]
        for word, table in (("down", parts_block.PARTS), ("hanging", parts_block.THREADS))
    }
    return found | {"uptime_s": reading["uptime"], "restarts": counts, **present}
