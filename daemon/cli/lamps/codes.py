"""`lumiloop codes`: prints the code tables of an air interface profile for lamp builders. Needs numpy, not the kernels.

Bits are as in docs/air-interface.md: the first bit sent comes first (the highest bit of the first byte in C). A half
chip of 1 is bright, 0 is dark, for a data bit of 0.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from typing import Final

from daemon.system.console import OK, USAGE, fail
from estimator import PROFILES, Profile, gold_codes

Row = tuple[int, str, str]
"""Number of a code, its chips, its half chips."""


def main(args: argparse.Namespace) -> int:
    """Runs the command; returns the exit code."""
    profile = PROFILES[args.profile]
    rows = table(profile)
    if args.code is not None:
        if not 0 <= args.code < len(rows):
            return fail(f"--code {args.code}: profile {profile.name} has codes 0 to {len(rows) - 1}", USAGE)
        rows = rows[args.code : args.code + 1]
    sys.stdout.write(FORMATS[args.format](profile, rows))
    return OK


def table(profile: Profile) -> list[Row]:
    """Returns all codes of a profile."""
    rows = []
    for number, chips in enumerate(gold_codes(profile.degree)):
        bits = "".join("1" if chip < 0 else "0" for chip in chips)
        rows.append((number, bits, manchester(bits)))
    return rows


def manchester(chips: str) -> str:
    """Returns the half chips of a string of chips: chip 0 is bright then dark, chip 1 dark then bright."""
    return chips.replace("0", "a").replace("1", "01").replace("a", "10")


def as_csv(profile: Profile, rows: Sequence[Row]) -> str:
    """Returns a header and one line per code."""
    del profile
    return "code,chips,half_chips\n" + "".join(f"{number},{chips},{halves}\n" for number, chips, halves in rows)


def as_json(profile: Profile, rows: Sequence[Row]) -> str:
    """Returns one object: the parameters of the profile, and the codes."""
    facts = {
        "profile": profile.name,
        "chip_rate_hz": profile.chip_rate,
        "half_chip_s": 0.5 / profile.chip_rate,
        "depth": profile.depth,
        "crystal_ppm": profile.crystal_ppm,
        "length": profile.length,
        "codes": [dict(zip(("code", "chips", "half_chips"), row, strict=True)) for row in rows],
    }
    return json.dumps(facts, indent=1) + "\n"


def as_c(profile: Profile, rows: Sequence[Row]) -> str:
    """Returns a C99 header with two tables of packed bits, in the order of code numbers."""
    name, length = f"lumiloop_{profile.name.lower()}", profile.length
    codes = f"code {rows[0][0]}" if len(rows) == 1 else f"codes {rows[0][0]} to {rows[-1][0]}"
    return (
        f"/* lumiloop air interface, profile {profile.name}: {codes}, {length} chips at {profile.chip_rate:g} per "
        f"second, depth {profile.depth:.2f}.\n"
        f" * Highest bit of the first byte is sent first; unused bits at the end are 0. A half chip lasts "
        f"{0.5e6 / profile.chip_rate:.9g} us; 1 is bright. */\n"
        "#include <stdint.h>\n\n"
        f"#define {name.upper()}_LENGTH {length}\n#define {name.upper()}_CODES {len(rows)}\n\n"
        + _array(f"{name}_chips", [chips for _, chips, _ in rows])
        + "\n"
        + _array(f"{name}_half_chips", [halves for _, _, halves in rows])
    )


def _array(name: str, rows: Sequence[str]) -> str:
    width = -(-len(rows[0]) // 8)
    lines = [f"static const uint8_t {name}[{len(rows)}][{width}] = {{"]
    for bits in rows:
        whole = int(bits.ljust(8 * width, "0"), 2).to_bytes(width, "big")
        lines.append("    {" + ", ".join(f"0x{byte:02X}" for byte in whole) + "},")
    return "\n".join([*lines, "};\n"])


FORMATS: Final[dict[str, Callable[[Profile, Sequence[Row]], str]]] = {"c": as_c, "csv": as_csv, "json": as_json}
