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
    Reason.WARMING_UP: ("starting up", "wait; the first start of a version compiles for a minute or two"),
    Reason.OPENING_LIDAR: ("the lidar is being opened", "wait a few seconds"),
    Reason.LIDAR_UNREACHABLE: ("the lidar cannot be opened", "read the log, then run `lumiloop probe`"),
    Reason.LIDAR_SILENT: (
        "no valid scan for three scan periods, or not steadily again",
        "check the lidar's power and cable",
    ),
    Reason.UNPROVED: ("the pose follows the laser, nothing has confirmed it yet", "wait, or drive a metre or two"),
    Reason.AXIS_UNKNOWN: ("the surroundings do not fix every axis of the pose", "read the known-axis bits"),
    Reason.MATCH_FAILED: ("scans do not fit the map, the pose is held", "is the lidar covered, lifted or crowded in?"),
    Reason.WITNESSES_DISAGREE: (
        "odometry and laser disagree about the motion",
        "wheel slip; if it lasts, check odometry scale and lidar mount",
    ),
    Reason.ODOMETRY_SILENT: ("odometry is configured and does not arrive", "check its sender and `odometry.port`"),
    Reason.UNCERTAIN: (
        "the robot may have moved further than anything has witnessed",
        "set the pose, or drive to where it was known; wheel odometry bridges such gaps",
    ),
    Reason.NO_WITNESS: ("nothing has confirmed the pose for too long", "set the pose, or drive to where it was known"),
    Reason.SEVERAL_PLACES: ("several places fit", "drive on until one is left"),
    Reason.SEARCHING: ("looking for the place in the map", "wait; where it lasts, drive a metre or two"),
    Reason.CONFIRMING: (
        "scans fit again, or light and pose draw together; being confirmed",
        "wait a few seconds; where it lasts, drive a metre or two",
    ),
    Reason.LIGHT_SILENT: (
        "the photodiode is configured and its samples do not arrive",
        "check its converter's power and bus; read the fault",
    ),
    Reason.LIGHT_DARK: (
        "the lamps have not told the place for a while: too few are received, or they do not agree on one",
        "are the lamps on, is the photodiode covered, is this part of the building surveyed? else drive a metre or two",
    ),
    Reason.LIGHT_DISAGREES: (
        "light and pose contradict each other about the place",
        "wait some seconds; if it lasts or comes again: lamps moved, a wrong survey, or the laser slipped",
    ),
    Reason.LIGHT_LOST: (
        "what is received does not fit the place, it is being found anew from the lamps",
        "drive a metre or two; if it lasts, check the survey",
    ),
    Reason.UNPLACED: (
        "where the robot stands and looks in the survey is not known yet",
        "drive a metre or two in view of three lamps, or set the pose",
    ),
    Reason.PAUSED: (
        "paused by command: the laser does not move the pose and the map is not touched",
        "give the command RESUME",
    ),
    Reason.OVERLOADED: (
        "the computer is too slow: the laser is left out, light and odometry carry the pose",
        "take load off the computer, or raise `cycle.budget_ms`",
    ),
}
"""Meaning and remedy of every reason."""
