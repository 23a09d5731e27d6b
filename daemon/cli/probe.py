"""``lumiloop probe``: finds lidars and photodiode converters; prints what they are, or the defect and its remedy."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys

from daemon.config.endpoints import LidarPlace, is_bus, parse_lidar
from daemon.system import console
from hal.bus import i2c_linux
from hal.bus.opening import open_bus
from hal.hokuyo import discover
from hal.hokuyo.probe import Finding, identify_at
from hal.photodiode.probe import BusFinding, Chip, probe_bus
from hal.port.opening import open_port

NOTHING = (
    "no sensor to examine: this computer has no serial device that may be a HOKUYO, and no I2C bus\n"
    "  USB lidar: connect it and switch it on\n"
    "  Ethernet lidar: name its address, as in `lumiloop probe tcp://192.168.0.10:10940`\n"
    "  photodiode: enable the I2C bus, or name a bus server, as in `lumiloop probe unix:/run/lumiloop/i2c`\n"
)

Found = Finding | BusFinding


def main(args: argparse.Namespace) -> int:
    """Runs the command ``probe``; 0 if a lidar or a converter was found, and one at every named device."""
    devices = list(args.devices) or [*discover.candidates(), *i2c_linux.buses()]
    if not devices and not args.json:
        sys.stderr.write(NOTHING)
        return 1
    try:
        places = {device: LidarPlace(device) if is_bus(device) else parse_lidar(device) for device in devices}
    except ValueError as error:
        return console.fail(str(error))
    findings = asyncio.run(_look(places, quiet=args.json))
    if args.json:
        sys.stdout.write(json.dumps([as_dict(finding) for finding in findings], indent=2) + "\n")
    good = sum(map(_usable, findings))
    return 0 if good and (not args.devices or good == len(findings)) else 1


async def _look(places: dict[str, LidarPlace], quiet: bool) -> list[Found]:
    """Examines the devices; ``places``: by the text that the user wrote for them."""
    findings: list[Found] = []
    for device, place in places.items():
        if not quiet:
            sys.stderr.write(f"probing {device} ...\n")
        bus = is_bus(device)
        finding: Found = (
            await probe_bus(open_bus, device.removeprefix("i2c+"))
            if bus
            else await identify_at(open_port, place.device, place.baud)
        )
        findings.append(finding)
        if not quiet:
            sys.stdout.write(describe(finding, device))
            sys.stdout.flush()
    return findings


def _usable(finding: Found) -> bool:
    if isinstance(finding, BusFinding):
        return any(chip.usable for chip in finding.chips)
    return finding.error is None


def describe(finding: Found, device: str) -> str:
    """Returns the text of a finding and how to use it; ``device``: as the user wrote it."""
    if isinstance(finding, BusFinding):
        use = (_how_to_use(finding.bus, chip) for chip in finding.chips)
        return "\n".join((str(finding), *(f"  use it: {text}" for text in use if text))) + "\n"
    if finding.error is not None:
        return f"no lidar: {finding}\n"
    return f"{finding}\n  use it: lumiloop run --lidar {device}\n"


def _how_to_use(bus: str, chip: Chip) -> str:
    """Returns the configuration keys for a converter; empty for other devices."""
    name = chip.name.lower().rpartition(" ")[2]  # either of two indistinguishable types works
    where = f"{name}@{chip.address:#04x}"
    if chip.usable:
        return f'photodiode.bus = "{bus}", photodiode.converter = "{where}"'
    return f'photodiode.level = "{where}/0"' if name else ""


def as_dict(finding: Found) -> dict[str, object]:
    """Returns a finding as a dict. Angles in degrees, ranges in m, times in s; unknown keys are absent."""
    if isinstance(finding, BusFinding):
        return _bus_as_dict(finding)
    if finding.error is not None:
        error = finding.error
        return {"device": finding.device, "problem": error.problem, "remedy": error.remedy}
    known: dict[str, object] = {"device": finding.device, "product": finding.product, "protocol": finding.protocol}
    known |= {"state": finding.state} if finding.state else {}
    known |= {"baud": finding.baud} if finding.baud else {}
    if (g := finding.geometry) is not None:
        known |= {
            "model": g.model,
            "serial": g.serial,
            "firmware": g.firmware,
            "beams": g.amax - g.amin + 1,
            "from_deg": round((g.amin - g.afrt) * 360.0 / g.ares, 3),
            "to_deg": round((g.amax - g.afrt) * 360.0 / g.ares, 3),
            "period_s": g.period_s,
            "range_m": [round(g.dmin * g.range_unit_m, 6), round(g.dmax * g.range_unit_m, 6)],
        }
    return known


def _bus_as_dict(finding: BusFinding) -> dict[str, object]:
    chips = [
        {"address": chip.address, "usable": chip.usable}
        | ({"name": chip.name} if chip.name else {})
        | ({"problem": chip.problem} if chip.problem else {})
        for chip in finding.chips
    ]
    known: dict[str, object] = {"bus": finding.bus, "adapter": finding.adapter, "chips": chips}
    if finding.error is not None:
        known |= {"problem": finding.error.problem, "remedy": finding.error.remedy}
    return known
