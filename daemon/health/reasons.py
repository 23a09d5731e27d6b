"""Reason table: every reason of a state with its number, meaning and remedy."""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class Reason(IntEnum):
    """Reasons of the published state. Numbers are part of the contract: never renumber."""

    NONE = 0
    WARMING_UP = 1
    OPENING_LIDAR = 2
    LIDAR_UNREACHABLE = 3
    LIDAR_SILENT = 4
    UNPROVED = 5
    AXIS_UNKNOWN = 6
    MATCH_FAILED = 7
    WITNESSES_DISAGREE = 8
    ODOMETRY_SILENT = 9
    UNCERTAIN = 10
    NO_WITNESS = 11
    SEVERAL_PLACES = 12
    SEARCHING = 13
    CONFIRMING = 14
    LIGHT_SILENT = 15
    LIGHT_DARK = 16
    LIGHT_DISAGREES = 17
    LIGHT_LOST = 18
    UNPLACED = 19
    PAUSED = 20
    OVERLOADED = 21


REASONS: Final[dict[Reason, tuple[str, str]]] = {
    Reason.NONE: ("the pose is confirmed", ""),
    Reason.WARMING_UP: ("starting", "wait; the first start of a version compiles for a minute or two"),
    Reason.OPENING_LIDAR: ("the lidar is being opened", "wait a few seconds"),
    Reason.LIDAR_UNREACHABLE: ("the lidar cannot be opened", "read the log, then run `lumiloop probe`"),
    Reason.LIDAR_SILENT: (
        "no valid scan for three scan periods, or scans are not steady yet",
        "read the fault; check the lidar's power and cable",
    ),
    Reason.UNPROVED: ("the pose follows the lidar; it is not confirmed yet", "wait, or drive a metre or two"),
    Reason.AXIS_UNKNOWN: (
        "the surroundings do not determine every axis of the pose",
        "use only the known axes and drive on; if it persists, send wheel odometry or add lamps",
    ),
    Reason.MATCH_FAILED: (
        "scans do not match the map; the pose is extrapolated",
        "check whether the lidar is covered, lifted or surrounded by people",
    ),
    Reason.WITNESSES_DISAGREE: (
        "odometry and lidar disagree about the motion",
        "check for wheel slip; if it persists, check odometry scale and lidar mount",
    ),
    Reason.ODOMETRY_SILENT: ("odometry is configured, but does not arrive", "check its sender and `odometry.port`"),
    Reason.UNCERTAIN: (
        "the robot may have moved further than the sensors have measured",
        "set the pose, or drive back to where it was known; wheel odometry bridges such gaps",
    ),
    Reason.NO_WITNESS: (
        "no sensor has confirmed the pose for too long",
        "set the pose, or drive back to where it was known",
    ),
    Reason.SEVERAL_PLACES: ("several poses are possible", "drive on until only one remains"),
    Reason.SEARCHING: ("searching for the pose in the map", "wait; if it persists, drive a metre or two"),
    Reason.CONFIRMING: (
        "position found again; waiting for confirmation",
        "wait a few seconds; if it persists, drive a metre or two",
    ),
    Reason.LIGHT_SILENT: (
        "the photodiode is configured, but its samples do not arrive",
        "check the converter's power and bus; read the fault",
    ),
    Reason.LIGHT_DARK: (
        "light does not determine the position: too few lamps are received, or they disagree",
        "check the lamps, the photodiode and the survey of this area; then drive a metre or two",
    ),
    Reason.LIGHT_DISAGREES: (
        "light and pose disagree about the position",
        "wait some seconds; if it persists or returns, check for moved lamps, a wrong survey or a wrong scan match",
    ),
    Reason.LIGHT_LOST: (
        "the received light does not fit the position; the light filter restarts",
        "drive a metre or two; if it persists, check the survey",
    ),
    Reason.UNPLACED: (
        "the pose in the survey is not known yet",
        "drive a metre or two in view of three lamps, or set the pose",
    ),
    Reason.PAUSED: (
        "paused by command: no mapping, and no correction of the pose by the lidar",
        "give the command RESUME",
    ),
    Reason.OVERLOADED: (
        "the computer is too slow: the daemon skips the lidar and uses light and odometry",
        "reduce the load of the computer, or raise `cycle.budget_ms`",
    ),
}
"""Meaning and remedy of every reason."""
