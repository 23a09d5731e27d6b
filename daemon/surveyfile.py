"""The light survey: which lamps hang where and how they shine, and the receiver they were calibrated with, as TOML.

A lamp is one line; whatever calibration and survey commands write can be read, edited and written again. Reading is
strict: an unknown key, a number that no lamp has, or two lamps with one number are refused with the file, the line,
the key and what was expected. The frame is the survey's, which becomes the map frame (docs/calibration.md).
"""

from __future__ import annotations

import difflib
import math
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta

from daemon.wholefile import write_whole
from estimator.cdma_profile import PROFILES, Profile
from estimator.lamps import Lamp, Receiver, Survey

Slope = Annotated[float, Meta(ge=-1.0, le=1.0)]
Metres = Annotated[float, Meta(ge=-10_000.0, le=10_000.0)]

_LAMP: Final = Lamp(lamp_id=0, code=0, x=0.0, y=0.0, z=3.0)
_RECEIVER: Final = Receiver()
_SURVEY: Final = Survey()
NEAREST_M: Final = 0.01
"""Two lamps closer than this are one lamp written twice."""
HEADROOM_M: Final = 0.2
"""Least height of a lamp above the receiver."""
DECIMALS: Final = 6


def last_code(profile: Profile) -> int:
    """The highest code number of an air interface; the lowest is 0 (`estimator.codes`)."""
    return profile.length + 1


_LAST_CODE: Final = max(map(last_code, PROFILES.values()))
"""Of any: which of them a file is for is said elsewhere."""


class SurveyError(Exception):
    """The survey cannot be used or written; the text says where, what was expected and what to do."""


class LampEntry(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """One lamp as the file has it."""

    lamp_id: Annotated[int, Meta(ge=0, le=65535, description="the lamp's number in the building, unique")]
    code: Annotated[int, Meta(ge=0, le=_LAST_CODE, description="number of the CDMA code it sends")]
    x: Annotated[Metres, Meta(description="metres, luminous centre")]
    y: Annotated[Metres, Meta(description="metres, luminous centre")]
    z: Annotated[float, Meta(ge=0.5, le=100.0, description="metres above the floor")]
    power_w: Annotated[float, Meta(ge=1e-4, le=1e4, description="mean radiant power, W")] = _LAMP.power_w
    order: Annotated[float, Meta(ge=0.05, le=60.0, description="Lambert order; or give half_angle_deg")] | None = None
    half_angle_deg: (
        Annotated[float, Meta(ge=5.0, le=89.0, description="angle at which intensity has halved; or give order")] | None
    ) = None
    slope_x: Annotated[Slope, Meta(description="lean of the lamp's axis towards x, metres per metre down")] = 0.0
    slope_y: Annotated[Slope, Meta(description="lean of the lamp's axis towards y, metres per metre down")] = 0.0
    sigma: Annotated[float, Meta(ge=1e-3, le=2.0, description="one sigma of ln(power); 0.05 is 5 %")] = _LAMP.sigma_ln

    def __post_init__(self) -> None:
        if self.order is not None and self.half_angle_deg is not None:
            raise ValueError("Expected `order` or `half_angle_deg`, got both")

    def lamp(self) -> Lamp:
        """As the estimator takes it."""
        order = _LAMP.order if self.order is None else self.order
        if self.half_angle_deg is not None:
            order = order_of(self.half_angle_deg)
        place = (self.lamp_id, self.code, self.x, self.y, self.z)
        return Lamp(*place, self.power_w, order, self.slope_x, self.slope_y, self.sigma)


class ReceiverEntry(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The photodiode as the file has it."""

    x: Annotated[float, Meta(ge=-5.0, le=5.0, description="metres ahead of the robot's centre")] = _RECEIVER.x
    y: Annotated[float, Meta(ge=-5.0, le=5.0, description="metres to the left of the robot's centre")] = _RECEIVER.y
    z: Annotated[float, Meta(ge=0.0, le=20.0, description="metres above the floor")] = _RECEIVER.z
    area_cm2: Annotated[float, Meta(ge=1e-4, le=100.0, description="its active area, cm^2")] = 1e4 * _RECEIVER.area_m2
    responsivity: Annotated[float, Meta(ge=1e-3, le=2.0, description="A per W")] = _RECEIVER.responsivity
    order: Annotated[float, Meta(ge=0.05, le=10.0, description="exponent of its cosine; 1 for a bare diode")] = (
        _RECEIVER.order
    )
    half_fov_deg: Annotated[float, Meta(ge=5.0, le=90.0, description="it sees nothing farther from its axis")] = 60.0
    slope_x: Annotated[Slope, Meta(description="lean of its axis forward, metres per metre up")] = 0.0
    slope_y: Annotated[Slope, Meta(description="lean of its axis to the left, metres per metre up")] = 0.0

    def receiver(self) -> Receiver:
        """As the estimator takes it."""
        area, half_fov = round(1e-4 * self.area_cm2, 12), math.radians(self.half_fov_deg)
        arm = (self.x, self.y, self.z)
        return Receiver(*arm, area, self.responsivity, self.order, half_fov, self.slope_x, self.slope_y)


class SurveyTree(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """The whole file."""

    lamp: Annotated[
        tuple[LampEntry, ...], Meta(description="the lamps; [] with a [receiver]: the lamps describe themselves")
    ]
    floor: Annotated[float, Meta(ge=0.0, le=0.5, description="diffuse light, part of a lamp's own at its nadir")] = (
        _SURVEY.floor
    )
    depth: (
        Annotated[float, Meta(ge=0.002, le=0.95, description="modulation depth of the lamps; default: the profile's")]
        | None
    ) = None
    receiver: ReceiverEntry | None = None

    def __post_init__(self) -> None:
        if not self.lamp and self.receiver is None:
            raise ValueError("Expected lamps, or a [receiver] for lamps that describe themselves, got neither")

    @property
    def eye(self) -> ReceiverEntry:
        """The receiver, a plain one where the file does not say."""
        return self.receiver or ReceiverEntry()

    def survey(self, profile: Profile | None) -> Survey:
        """As the estimator takes it; lamps in order of their numbers, the profile's depth where the file says none."""
        lamps = sorted((entry.lamp() for entry in self.lamp), key=lambda lamp: lamp.lamp_id)
        return Survey(tuple(lamps), self.eye.receiver(), self.floor, self._depth(profile))

    def _depth(self, profile: Profile | None) -> float:
        if self.depth is not None:
            return self.depth
        return _SURVEY.depth if profile is None else profile.depth


def order_of(half_angle_deg: float) -> float:
    """Lambert order of a lamp whose intensity has halved at this angle (Eq. 1)."""
    return -math.log(2.0) / math.log(math.cos(math.radians(half_angle_deg)))


def residuals_beside(survey: Path) -> Path:
    """Where a survey's residual map lies (daemon/residualfile.py), if it has one."""
    return survey.with_suffix(".residuals.npz")


def read_survey(path: Path, profile: Profile | None = None) -> Survey:
    """Read a survey.

    Args:
        path: of the file.
        profile: air interface the lamps have to have; None: any, and depth is profile A's where the file says none.

    Raises:
        SurveyError: missing, unreadable, not TOML, an unknown key, a wrong or implausible value, a lamp twice, a code
            that the profile does not have.
    """
    text = _read(path)
    try:
        tree = msgspec.convert(tomllib.loads(text), SurveyTree)
    except tomllib.TOMLDecodeError as error:
        raise SurveyError(f"{path}: not valid TOML: {error}") from None
    except msgspec.ValidationError as error:
        raise SurveyError(_explain(path, text, str(error))) from None
    _check_lamps(path, text, tree)
    if profile is not None:
        _check_codes(path, text, tree, profile)
    return tree.survey(profile)


def write_survey(
    path: Path, survey: Survey, notes: Sequence[str] = (), remarks: Mapping[int, str] | None = None, force: bool = False
) -> None:
    """Write a survey whole or not at all, synced to the disk; reading it back yields an equal one (to 1e-6).

    Args:
        path: where to.
        survey: what.
        notes: lines of comment at the head.
        remarks: comment behind a lamp, by lamp ID.
        force: replace a file that is there.

    Raises:
        SurveyError: there is such a file already, or it cannot be written.
    """
    if path.exists() and not force:
        raise SurveyError(f"{path} exists: name another file, or ask for it to be replaced with --force")
    try:
        write_whole(path, dump(survey, notes, remarks or {}).encode())
    except OSError as error:
        raise SurveyError(f"cannot write {path}: {error.strerror}; free space or name another file") from error


def dump(survey: Survey, notes: Sequence[str] = (), remarks: Mapping[int, str] | None = None) -> str:
    """The survey as TOML, always in the same order."""
    lines = [
        f"# {note}".rstrip() for note in ("Light survey of lumiloop: metres, watts, slopes; frame: the map's.", *notes)
    ]
    lines += ["", f"depth = {_number(survey.depth)}", f"floor = {_number(survey.floor)}", "", "lamp = ["]
    rows = [_lamp_row(lamp) for lamp in sorted(survey.lamps, key=lambda lamp: lamp.lamp_id)]
    widths = [max(len(row[at]) for row in rows) for at in range(len(rows[0]))] if rows else []
    for lamp, row in zip(sorted(survey.lamps, key=lambda lamp: lamp.lamp_id), rows, strict=True):
        cells = " ".join(f"{cell},".ljust(width + 1) for cell, width in zip(row, widths, strict=True)).rstrip(" ,")
        remark = (remarks or {}).get(lamp.lamp_id, "")
        lines.append(f"  {{ {cells} }},{f'  # {remark}' if remark else ''}")
    lines += ["]", "", "[receiver]", *_receiver_rows(survey.receiver)]
    return "\n".join(lines) + "\n"


def _lamp_row(lamp: Lamp) -> list[str]:
    values = {
        "lamp_id": lamp.lamp_id,
        "code": lamp.code,
        **{name: getattr(lamp, name) for name in ("x", "y", "z", "power_w", "order", "slope_x", "slope_y")},
        "sigma": lamp.sigma_ln,
    }
    return [f"{name} = {_number(value)}" for name, value in values.items()]


def _receiver_rows(receiver: Receiver) -> list[str]:
    values = {
        **{name: getattr(receiver, name) for name in ("x", "y", "z")},
        "area_cm2": 1e4 * receiver.area_m2,
        "responsivity": receiver.responsivity,
        "order": receiver.order,
        "half_fov_deg": math.degrees(receiver.half_fov_rad),
        "slope_x": receiver.slope_x,
        "slope_y": receiver.slope_y,
    }
    return [f"{name} = {_number(value)}" for name, value in values.items()]


def _number(value: float) -> str:
    return repr(value) if isinstance(value, int) else repr(round(float(value), DECIMALS) + 0.0)


def _read(path: Path) -> str:
    try:
        return path.read_bytes().decode()
    except FileNotFoundError:
        raise SurveyError(f"{path}: no such survey (`lumiloop survey` makes one from a drive)") from None
    except UnicodeDecodeError as error:
        raise SurveyError(f"{path}: not UTF-8 text at byte {error.start}") from None
    except OSError as error:
        raise SurveyError(f"{path}: cannot be read: {error.strerror}") from None


def _check_lamps(path: Path, text: str, tree: SurveyTree) -> None:
    """What only shows when all lamps are looked at together; raises `SurveyError`."""
    seen: dict[int, int] = {}
    for index, entry in enumerate(tree.lamp):
        place = f"{path}{_at(text, index)}: lamp {entry.lamp_id}"
        if entry.lamp_id in seen:
            raise SurveyError(f"{place}: that `lamp_id` is taken already{_at(text, seen[entry.lamp_id], ' by line ')}")
        seen[entry.lamp_id] = index
        if entry.z < tree.eye.z + HEADROOM_M:
            raise SurveyError(f"{place}: hangs at z = {entry.z} m, not above the receiver (z = {tree.eye.z} m)")
        for other in tree.lamp[:index]:
            if math.dist((entry.x, entry.y, entry.z), (other.x, other.y, other.z)) < NEAREST_M:
                raise SurveyError(f"{place}: hangs where lamp {other.lamp_id} hangs; correct or delete one of them")


def _check_codes(path: Path, text: str, tree: SurveyTree, profile: Profile) -> None:
    """Whether the profile has the lamps' codes; raises `SurveyError`."""
    for index, entry in enumerate(tree.lamp):
        if entry.code > last_code(profile):
            raise SurveyError(
                f"{path}{_at(text, index, key='code')}: lamp {entry.lamp_id}: code {entry.code} is none of profile "
                f"{profile.name}, which has codes 0 to {last_code(profile)}; correct it, or `photodiode.profile`"
            )


def _explain(path: Path, text: str, message: str) -> str:
    """The error with line, key and purpose; an unknown key with the nearest known one."""
    where = match[1] if (match := re.search(r"at `\$\.?([^`]*)`", message)) else ""
    index = int(found[1]) if (found := re.match(r"lamp\[(\d+)\]", where)) else None
    kind = LampEntry if index is not None else ReceiverEntry if where.startswith("receiver") else SurveyTree
    table = "receiver" if kind is ReceiverEntry else ""
    names = list(kind.__struct_fields__)
    if unknown := re.search(r"unknown field `([^`]*)`", message):
        near = difflib.get_close_matches(unknown[1], names, n=1)
        hint = f"did you mean `{near[0]}`?" if near else f"known here are {', '.join(names)}"
        return f"{path}{_at(text, index, key=unknown[1], table=table)}: unknown key `{unknown[1]}`; {hint}"
    key = where.rpartition(".")[2] if "." in where or index is None else ""
    if inner := re.search(r"in `([a-z_0-9]+)`", message):
        key = inner[1]
    purpose = _purposes(kind).get(key, "")
    return f"{path}{_at(text, index, key=key, table=table)}: {message}{f' ({purpose})' if purpose else ''}"


def _purposes(kind: type[msgspec.Struct]) -> dict[str, str]:
    schema: dict[str, Any] = msgspec.json.schema(kind)["$defs"][kind.__name__]["properties"]
    return {name: _described(entry) for name, entry in schema.items()}


def _described(entry: dict[str, Any]) -> str:
    choices = [entry, *entry.get("anyOf", ())]
    return next((str(choice["description"]) for choice in choices if "description" in choice), "")


def _at(text: str, lamp: int | None, before: str = ":", key: str = "", table: str = "") -> str:
    """``:LINE`` of a lamp (its first line where they are written as tables) or of a key; empty where not found."""
    lines = [line.partition("#")[0] for line in text.splitlines()]
    first, last = _span(lines, lamp, table)
    own = [at for at in range(first, last) if key and re.match(rf"\s*{re.escape(key)}\s*=", lines[at])]
    if own:
        return f"{before}{own[0] + 1}"
    return f"{before}{first + 1}" if (lamp is not None or table) and first < last else ""


def _span(lines: list[str], lamp: int | None, table: str) -> tuple[int, int]:
    """Lines of a lamp or of a table: the first, and the one after the last; an empty span where there is none."""
    if lamp is None:
        begins = [at for at, line in enumerate(lines) if re.match(rf"\s*\[\s*{table}\s*\]", line)] if table else [0]
        return (begins[0], len(lines)) if begins else (0, 0)
    tables = any(re.match(r"\s*\[\[", line) for line in lines)
    start = r"\s*\[\[\s*lamp\s*\]\]" if tables else r"[^{]*\{.*"
    begins = [at for at, line in enumerate(lines) if re.match(start, line)]
    if lamp >= len(begins):
        return 0, 0
    return begins[lamp], begins[lamp + 1] if lamp + 1 < len(begins) else len(lines)
