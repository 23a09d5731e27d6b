"""``lumiloop probe``: find lidars and say what they are, or why one could not be opened and what to do."""

from __future__ import annotations

import argparse
import asyncio
import json
import sys

from hal.hokuyo import discover
from hal.opening import open_port
from hal.probe import Finding, identify_at

NOTHING = (
    "nothing to look at: no serial device that may be a HOKUYO is plugged in\n"
    "  plug the sensor in and give it power; an Ethernet model is not searched for, name it:\n"
    "  lumiloop probe tcp://192.168.0.10:10940\n"
)


def main(args: argparse.Namespace) -> int:
    """The command ``probe``; 0 when at least one lidar was found and every device named is one."""
    devices = list(args.devices) or discover.candidates()
    if not devices and not args.json:
        sys.stderr.write(NOTHING)
        return 1
    findings = asyncio.run(_look(devices, quiet=args.json))
    if args.json:
        sys.stdout.write(json.dumps([as_dict(finding) for finding in findings], indent=2) + "\n")
    lidars = sum(finding.error is None for finding in findings)
    return 0 if lidars and (not args.devices or lidars == len(findings)) else 1


async def _look(devices: list[str], quiet: bool) -> list[Finding]:
    findings = []
    for device in devices:
        if not quiet:
            sys.stderr.write(f"looking at {device} ...\n")
        finding = await identify_at(open_port, device)
        findings.append(finding)
        if not quiet:
            sys.stdout.write(describe(finding))
            sys.stdout.flush()
    return findings


def describe(finding: Finding) -> str:
    """What a person wants to read: the line and how to use it."""
    if finding.error is not None:
        return f"no lidar: {finding}\n"
    return f"{finding}\n  use it: lumiloop run --lidar {finding.device}\n"


def as_dict(finding: Finding) -> dict[str, object]:
    """The same for programs. Angles in degrees, ranges in m, times in s; keys are absent where nothing is known."""
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
