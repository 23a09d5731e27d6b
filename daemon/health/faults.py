"""Fault table: every fault with its number, meaning and remedy."""

from __future__ import annotations

from enum import IntEnum
from typing import Final


class Fault(IntEnum):
    """Faults, the gravest first. Numbers are part of the contract: never renumber."""

    NONE = 0
    LIDAR_MISSING = 101
    LIDAR_REFUSED = 102
    LIDAR_BROKEN = 103
    LIDAR_SILENT = 104
    LIDAR_GARBLED = 105
    LIDAR_GAPS = 106
    LIDAR_LATE = 107
    LIDAR_MISFIT = 108
    LIDAR_TURNED = 109
    ADC_BUS_MISSING = 151
    ADC_BUS_REFUSED = 152
    ADC_MISSING = 153
    ADC_WRONG = 154
    ADC_BUS_STUCK = 155
    ADC_BUS_FAULTY = 156
    ADC_SILENT = 157
    ADC_GARBLED = 158
    NO_SIGNAL = 159
    DARK = 160
    DAZZLED = 161
    CLIPPED = 162
    ADC_RATE = 163
    ADC_STALLS = 164
    ADC_GAPS = 165
    NO_LAMPS = 171
    SURVEY_CONTRADICTED = 172
    TWIN_LAMPS = 173
    LAMP_MOVED = 174
    LAMP_DEAD = 175
    ODOMETRY_SILENT = 201
    ODOMETRY_JUMPS = 202
    ODOMETRY_DISAGREES = 203
    ODOMETRY_GAPS = 204
    ODOMETRY_SCALE = 205
    PROTECTION_ALERT = 251
    LOOP_STALLED = 301
    OVERRUNS = 302
    WORKER_FAILED = 303
    OVERLOADED = 304
    PART_FAILED = 305
    COMPUTER_SLOW = 306
    NO_DESCRIPTORS = 307
    PUBLISHER_FAILED = 401
    RECORDER_FAILED = 402
    MAP_NOT_SAVED = 403
    MAP_REFUSED = 404
    POSE_NOT_KEPT = 405
    FLIGHT_RECORDER_FAILED = 406
    THREAD_HANGS = 407


FAULTS: Final[dict[Fault, tuple[str, str]]] = {
    Fault.NONE: ("no fault", ""),
    Fault.LIDAR_MISSING: ("the lidar is not there", "check power, cable and `lidar.device`; run `lumiloop probe`"),
    Fault.LIDAR_REFUSED: (
        "the lidar's port may not be used, or its network address turns the connection away",
        "serial: join the group dialout; Ethernet: is it on, is the port right, is it another client's? close what "
        "else uses it, or name another `lidar.device`",
    ),
    Fault.LIDAR_BROKEN: (
        "the lidar reports a fault of its own, or its port is open and nothing answers",
        "it starts up for some seconds after power-on; else check its power and cable, power it off and on; if that "
        "does not help, replace it",
    ),
    Fault.LIDAR_SILENT: ("the lidar is connected and sends no valid scan", "power it off and on; check the cable"),
    Fault.LIDAR_GARBLED: ("more than 5 % of the lidar's frames are damaged", "check cable, shielding and USB hub"),
    Fault.LIDAR_GAPS: ("more than 2 % of the lidar's scans are missing", "check the computer's load and the line rate"),
    Fault.LIDAR_LATE: (
        "scans arrive more than two periods after they were measured, or are all stamped late against the wheels",
        "take load off the computer; look for a slow line, a USB hub or a network in between, and for a driver or "
        "gateway that stamps scans at arrival, not when they were measured",
    ),
    Fault.LIDAR_MISFIT: (
        "what the lidar measures does not fit the map where the robot must be, or anywhere after a start",
        "was the robot moved by hand, or does it drive where the map knows nothing yet? is the lidar covered, shifted "
        "on its mount, or does it measure wrongly?",
    ),
    Fault.LIDAR_TURNED: (
        "the lidar is not mounted as configured",
        "measure its mount, or record a drive and run `lumiloop calibrate --lidar-mount`; correct `lidar.mount`",
    ),
    Fault.ADC_BUS_MISSING: (
        "the photodiode's I2C bus is not there",
        "check `photodiode.bus`; is I2C enabled, is the adapter plugged in, does the bus server run?",
    ),
    Fault.ADC_BUS_REFUSED: (
        "the photodiode's I2C bus may not be used, or cannot do what is needed",
        "join the group i2c, unbind what else uses the converter, or use an I2C controller of the processor",
    ),
    Fault.ADC_MISSING: (
        "no converter answers on the photodiode's bus",
        "check its power and wiring, and `photodiode.converter`; run `lumiloop probe`",
    ),
    Fault.ADC_WRONG: ("another chip answers than `photodiode.converter` says", "run `lumiloop probe`, correct the key"),
    Fault.ADC_BUS_STUCK: (
        "the photodiode's bus hangs",
        "switch the converter's power off and on; look for SDA or SCL held low",
    ),
    Fault.ADC_BUS_FAULTY: (
        "reads of the photodiode's converter fail",
        "check wiring, pull-ups and cable length; read the log",
    ),
    Fault.ADC_SILENT: ("the photodiode's converter is connected and delivers nothing", "read the log"),
    Fault.ADC_GARBLED: (
        "the converter's words are damaged, or another kind of chip sends them",
        "check `photodiode.converter`, wiring and pull-ups",
    ),
    Fault.NO_SIGNAL: (
        "the photodiode gives no signal: dark, dazzled, or a dead converter",
        "look for a cover, for lamps off, for glaring light; a DC channel (`photodiode.level`) would tell which",
    ),
    Fault.DARK: ("no light reaches the photodiode", "look for a cover, a broken cable, lamps off"),
    Fault.DAZZLED: ("the photodiode's amplifier is saturated", "shade the photodiode or lower the gain"),
    Fault.CLIPPED: (
        "more than a fifth of the samples are at the rails",
        "too much modulated or flickering light: shade the photodiode or lower the gain",
    ),
    Fault.ADC_RATE: (
        "the converter is not clocked as the air interface needs it",
        "set SCL to 18 times the sample rate of `photodiode.profile`: 400 kHz for A",
    ),
    Fault.ADC_STALLS: (
        "the bus stands still inside many blocks of samples",
        "take load off the computer, or serve the bus from a process of its own: python -m hal.bus.i2c_server",
    ),
    Fault.ADC_GAPS: ("more than 2 % of the blocks of samples are lost", "take load off the computer"),
    Fault.NO_LAMPS: (
        "there is light, and no lamp in it can be decoded",
        "are coded lamps on and in view? `photodiode.profile` must be that of the lamps",
    ),
    Fault.SURVEY_CONTRADICTED: (
        "what is received does not fit the survey",
        "is `lights.survey` that of this building? calibrate anew: lumiloop calibrate",
    ),
    Fault.TWIN_LAMPS: (
        "two lamps with one code are in view",
        "give one of them another code; read the links: lumiloop status",
    ),
    Fault.LAMP_MOVED: (
        "a lamp does not shine as surveyed",
        "moved or exchanged? the log names it; survey it anew",
    ),
    Fault.LAMP_DEAD: ("a lamp is not received where it must be", "the log names it: replace it or switch it on"),
    Fault.ODOMETRY_SILENT: ("configured odometry does not arrive", "check its sender and `odometry.port`"),
    Fault.ODOMETRY_JUMPS: ("odometry has jumped", "its sender was restarted, or two senders use `odometry.port`"),
    Fault.ODOMETRY_DISAGREES: (
        "odometry and laser disagree",
        "wheel slip; if it lasts, check odometry scale and lidar mount",
    ),
    Fault.ODOMETRY_GAPS: (
        "odometry readings are lost, late, stamped late against the scans, or come more seldom than before",
        "check the network and the sender's load; send ten readings per second or more, at once and stamped when they "
        "were measured: does something on their way stamp them at arrival?",
    ),
    Fault.ODOMETRY_SCALE: (
        "odometry is wrong by a constant factor or turns by itself; the pose is corrected for it",
        "measure wheels and track, or record a drive and run `lumiloop calibrate --odometry`; correct its sender",
    ),
    Fault.PROTECTION_ALERT: (
        "the position error may be above the limit that is set, `integrity.alert_m`",
        "read state and reason; drive to where the pose is known, or set a limit that the place allows",
    ),
    Fault.LOOP_STALLED: ("the process did not get to run for two scan periods", "take load off the computer"),
    Fault.OVERRUNS: ("more than 5 % of the cycles exceed their budget", "take load off the computer"),
    Fault.WORKER_FAILED: ("background work has failed", "read the log; please report it"),
    Fault.OVERLOADED: (
        "map work, or the laser itself, is left out for lack of time",
        "take load off the computer, or raise `cycle.budget_ms`; the stages' times are published",
    ),
    Fault.PART_FAILED: (
        "a part of the daemon has failed and is started again and again",
        "read the log, which names it: is `odometry.port` taken by another program? a defect: please report it",
    ),
    Fault.COMPUTER_SLOW: (
        "the computer is too slow for its work, or other programs take its time",
        "end other programs or move them to another computer; what follows from it is over with it",
    ),
    Fault.NO_DESCRIPTORS: (
        "no file descriptors are left to the daemon, or hardly any",
        "end clients that keep many connections open, or raise `LimitNOFILE=` of the service (`ulimit -n` in a shell)",
    ),
    Fault.PUBLISHER_FAILED: (
        "a publisher cannot send or listen",
        "read the log, which names it: is the port, or the stream's socket, taken by another program or daemon? can "
        "all of `pose.receivers` be reached (the network's cable, a name)?",
    ),
    Fault.RECORDER_FAILED: (
        "the recording cannot be written",
        "free disk space, let the daemon write there (owner, mode, a disk that is mounted read-only), or name another "
        "directory; the log says which",
    ),
    Fault.MAP_NOT_SAVED: (
        "the map cannot be saved; what was saved before stays",
        "read the log; free disk space, end another daemon that keeps its maps there, or name another `map.folder`",
    ),
    Fault.MAP_REFUSED: (
        "a stored map cannot be used",
        "the log names the file, why, and what to do; without one a new map is begun",
    ),
    Fault.POSE_NOT_KEPT: (
        "the pose cannot be kept for the next start",
        "read the log; free disk space, or name another `map.folder` that may be written",
    ),
    Fault.FLIGHT_RECORDER_FAILED: (
        "the flight recorder cannot keep a state or a dump",
        "free disk space where it records, see the log for what is in the way",
    ),
    Fault.THREAD_HANGS: (
        "a thread of the daemon does not come back",
        "the log names it: look for a disk or a bus that hangs; a computation that hangs ends in a restart",
    ),
}
"""Meaning and remedy of every fault."""


def describe_over(fault: Fault, seconds: float) -> str:
    """Log line of a fault that is over, with its duration in s."""
    return f"over: fault {int(fault)}: {FAULTS[fault][0]}; it lasted {seconds:.0f} s"


def describe_consequence(fault: Fault, cause: Fault) -> str:
    """Log line of a fault that follows from another one."""
    return f"fault {int(fault)} follows from fault {int(cause)}: {FAULTS[fault][0]}"
