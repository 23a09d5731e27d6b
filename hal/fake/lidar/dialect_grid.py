"""Response of the sensor to a command in each state: one grid per SCIP dialect.

``do`` carries the command out, ``--`` sends no answer, any other entry is the status of a refusal. The BM, QT, RS, TM
and RB rows of 2.2 follow the observed behaviour of UST sensors. The refusals of M* and G*, the TIME_ADJUST column of
2.0, the BOOTING row of M* and G* and the SLEEP column follow the documents and were not confirmed on a sensor: drivers
must cope with any of them.
"""

from __future__ import annotations

from enum import Enum
from typing import Literal

from hal.fake.lidar.commands import SINGLES, STREAMS


class State(Enum):
    """State of the sensor; the value is its ``%ST`` code (MULTI and ERROR as in C-42-04076)."""

    IDLE = "000"
    BOOTING = "001"
    TIME_ADJUST = "002"
    SINGLE = "003"
    MULTI = "004"
    SLEEP = "005"
    ERROR = "900"
    SCIP1 = "---"


COLUMNS = (State.BOOTING, State.IDLE, State.SINGLE, State.MULTI, State.TIME_ADJUST, State.ERROR, State.SLEEP)

GRID_2_0 = """
ask   do  do  do  do  0E  do  do
BM    10  do  02  02  0E  0L  10
QT    00  do  do  do  00  0L  do
RS    do  do  do  do  do  0L  do
TM0   10  do  do  0E  02  0L  10
TM1   10  do  do  do  do  0L  10
TM2   10  03  10  10  do  0L  10
M     10  do  do  do  0E  0L  10
G     10  10  do  do  0E  0L  10
RB    do  do  do  do  do  do  do
set   10  do  do  do  0E  0L  10
"""

GRID_2_2 = """
ask   --  do  do  do  do  do  do
BM    10  do  02  02  10  0L  10
QT    00  do  do  do  10  0L  do
RS    do  do  do  do  do  0L  do
TM0   10  do  do  10  02  0L  10
TM1   10  do  do  do  do  0L  10
TM2   10  03  10  10  do  0L  10
M     10  do  do  do  10  0L  10
G     10  10  do  do  0E  0L  10
RB    do  do  do  do  do  do  do
set   10  do  do  do  10  0L  10
%ST   do  do  do  do  do  do  do
%SL   10  do  do  do  10  0L  do
"""


def _read(grid: str) -> dict[str, dict[State, str]]:
    rows = (line.split() for line in grid.split("\n") if line)
    return {row[0]: dict(zip(COLUMNS, row[1:], strict=True)) for row in rows}


GRIDS = {"2.0": _read(GRID_2_0), "2.2": _read(GRID_2_2)}

ROW = {"VV": "ask", "PP": "ask", "II": "ask", "RT": "RS", "SS": "set", "CR": "set", "HS": "set"}
ROW |= dict.fromkeys(STREAMS, "M") | dict.fromkeys(SINGLES, "G")


def response(profile: Literal["2.0", "2.2"], state: State, name: str, parameters: bytes) -> str:
    """``do``, ``--`` or the status of a refusal."""
    if name == "TM":
        if parameters not in (b"0", b"1", b"2"):
            return "01"
        name += parameters.decode("ascii")
    return GRIDS[profile][ROW.get(name, name)][state]
