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
    LIDAR_FROZEN = 110
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
    GYRO_SCALE = 206
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
    Fault.LIDAR_MISSING: ("no lidar is found", "check power, cable and `lidar.device`; run `lumiloop probe`"),
    Fault.LIDAR_REFUSED: (
        "access to the lidar is denied, or its network address refuses the connection",
        "serial: add the user to group dialout, and close other programs on the port; Ethernet: check power, "
        "address and port, and disconnect other clients",
    ),
    Fault.LIDAR_BROKEN: (
        "the lidar reports an internal fault, or it does not answer on its open port",
        "wait some seconds after power-on, then check power and cable and power it off and on; replace it if "
        "the fault persists",
    ),
    Fault.LIDAR_SILENT: ("the lidar is connected, but sends no valid scan", "power it off and on; check the cable"),
    Fault.LIDAR_GARBLED: ("more than 5 % of the lidar's frames are damaged", "check cable, shielding and USB hub"),
    Fault.LIDAR_GAPS: ("more than 2 % of the lidar's scans are missing", "check the computer's load and the line rate"),
    Fault.LIDAR_LATE: (
        "scans arrive more than two periods after their measurement, or their stamps are late against odometry",
        "reduce the load of the computer and check line, USB hub and network; a driver or gateway must stamp "
        "scans at measurement, not at arrival",
    ),
    Fault.LIDAR_MISFIT: (
        "scans do not match the map at the expected pose, or anywhere after a start",
        "check whether the robot was moved by hand or is outside the mapped area; check the lidar's window and mount",
    ),
    Fault.LIDAR_TURNED: (
        "the mount of the lidar differs from `lidar.mount`, which is corrected in the pose",
        "measure the mount, or record a drive and run `lumiloop calibrate --lidar-mount`; then correct `lidar.mount`",
    ),
    Fault.LIDAR_FROZEN: (
        "the lidar repeats one scan while the robot moves; the pose uses odometry and light",
        "power it off and on; restart a driver or gateway that passes its scans on",
    ),
    Fault.ADC_BUS_MISSING: (
        "the photodiode's I2C bus is not found",
        "check `photodiode.bus`, that I2C is enabled, that the adapter is plugged in, and that the bus server runs",
    ),
    Fault.ADC_BUS_REFUSED: (
        "access to the photodiode's I2C bus is denied, or the adapter lacks a needed function",
        "add the user to group i2c, unbind other drivers from the converter, or use an I2C controller of the processor",
    ),
    Fault.ADC_MISSING: (
        "no converter answers on the photodiode's bus",
        "check its power and wiring, and `photodiode.converter`; run `lumiloop probe`",
    ),
    Fault.ADC_WRONG: (
        "the converter is of another type than `photodiode.converter`",
        "run `lumiloop probe` and correct the key",
    ),
    Fault.ADC_BUS_STUCK: (
        "the photodiode's bus is stuck",
        "switch the converter's power off and on; check whether SDA or SCL is held low",
    ),
    Fault.ADC_BUS_FAULTY: (
        "reads of the photodiode's converter fail",
        "check wiring, pull-ups and cable length; read the log",
    ),
    Fault.ADC_SILENT: ("the photodiode's converter is connected, but delivers no samples", "read the log"),
    Fault.ADC_GARBLED: (
        "the converter's data words are damaged, or come from another type of converter",
        "check `photodiode.converter`, wiring and pull-ups",
    ),
    Fault.NO_SIGNAL: (
        "the photodiode gives no signal: no light, saturation, or a defective converter",
        "check for a cover, for lamps that are off, and for glare; a DC channel (`photodiode.level`) "
        "distinguishes them",
    ),
    Fault.DARK: ("no light reaches the photodiode", "check for a cover, a broken cable, and lamps that are off"),
    Fault.DAZZLED: ("the photodiode's amplifier is saturated", "shade the photodiode or lower the gain"),
    Fault.CLIPPED: (
        "more than 20 % of the samples are at the limits of the converter",
        "reduce modulated or flickering light: shade the photodiode or lower the gain",
    ),
    Fault.ADC_RATE: (
        "the converter's sample rate does not fit the air interface",
        "set the SCL clock to 18 times the sample rate of `photodiode.profile`: 400 kHz for A",
    ),
    Fault.ADC_STALLS: (
        "the bus pauses within many blocks of samples",
        "reduce the load of the computer, or serve the bus from a separate process: python -m hal.bus.i2c_server",
    ),
    Fault.ADC_GAPS: ("more than 2 % of the blocks of samples are lost", "reduce the load of the computer"),
    Fault.NO_LAMPS: (
        "light is received, but no lamp can be decoded",
        "check that coded lamps are on and in view, and that `photodiode.profile` is theirs",
    ),
    Fault.SURVEY_CONTRADICTED: (
        "the received light does not fit the survey",
        "check that `lights.survey` is the survey of this building; calibrate again: lumiloop calibrate",
    ),
    Fault.TWIN_LAMPS: (
        "two lamps with one code are in view",
        "give one of them another code; `lumiloop status` lists the links",
    ),
    Fault.LAMP_MOVED: (
        "the light of a lamp differs from its survey",
        "the log names the lamp: check whether it was moved or exchanged, then survey it again",
    ),
    Fault.LAMP_DEAD: (
        "a lamp is not received where it is expected",
        "the log names the lamp: switch it on or replace it",
    ),
    Fault.ODOMETRY_SILENT: ("odometry is configured, but does not arrive", "check its sender and `odometry.port`"),
    Fault.ODOMETRY_JUMPS: (
        "the odometry pose has jumped",
        "check whether its sender was restarted, or two senders use `odometry.port`",
    ),
    Fault.ODOMETRY_DISAGREES: (
        "odometry and lidar disagree about the motion",
        "check for wheel slip; if it persists, check odometry scale and lidar mount",
    ),
    Fault.ODOMETRY_GAPS: (
        "odometry readings are lost, late, less frequent than before, or have late stamps",
        "check the network and the sender's load; send ten readings per second or more, without delay, "
        "stamped at measurement and not at arrival",
    ),
    Fault.ODOMETRY_SCALE: (
        "odometry has a constant scale error or drift, which is corrected in the pose",
        "measure wheels and track, or record a drive and run `lumiloop calibrate --odometry`; then correct its sender",
    ),
    Fault.GYRO_SCALE: (
        "the gyro measures turns with a wrong factor; its readings are not used",
        "send the turn about the vertical axis in rad, counter-clockwise positive (REP-103); check unit, sign and axis",
    ),
    Fault.PROTECTION_ALERT: (
        "the protection level is above `integrity.alert_m`, or there is none",
        "read state and reason; drive to where the pose is known, or set a higher limit",
    ),
    Fault.LOOP_STALLED: ("the process could not run for two scan periods", "reduce the load of the computer"),
    Fault.OVERRUNS: ("more than 5 % of the cycles exceed their budget", "reduce the load of the computer"),
    Fault.WORKER_FAILED: ("a background job has failed", "read the log and report the defect"),
    Fault.OVERLOADED: (
        "the daemon skips map work or the lidar for lack of computing time",
        "reduce the load of the computer, or raise `cycle.budget_ms`; the stage times are published",
    ),
    Fault.PART_FAILED: (
        "a component of the daemon has failed and is restarted repeatedly",
        "the log names the component: check whether another program uses `odometry.port`; otherwise report the defect",
    ),
    Fault.COMPUTER_SLOW: (
        "the computer is too slow, or other programs use its processor",
        "end other programs or move them to another computer; faults that follow from this one end with it",
    ),
    Fault.NO_DESCRIPTORS: (
        "the daemon has almost no free file descriptors",
        "end clients with many open connections, or raise `LimitNOFILE=` of the service (`ulimit -n` in a shell)",
    ),
    Fault.PUBLISHER_FAILED: (
        "a publisher cannot send or listen",
        "the log names it: check whether another program or daemon uses the port or the stream's socket; "
        "check that all `pose.receivers` can be reached",
    ),
    Fault.RECORDER_FAILED: (
        "the daemon cannot write the recording",
        "read the log, then free disk space, correct owner and mode of the directory or the mount, or name "
        "another directory",
    ),
    Fault.MAP_NOT_SAVED: (
        "the daemon cannot save the map; the stored map remains",
        "read the log, then free disk space, end another daemon with the same folder, or name another `map.folder`",
    ),
    Fault.MAP_REFUSED: (
        "the daemon cannot use a stored map",
        "the log names the file, the cause and the remedy; without a stored map the daemon begins a new one",
    ),
    Fault.POSE_NOT_KEPT: (
        "the daemon cannot store the pose for the next start",
        "read the log, then free disk space, or name another `map.folder` with write access",
    ),
    Fault.FLIGHT_RECORDER_FAILED: (
        "the flight recorder cannot write a checkpoint or a dump",
        "free disk space in its directory; the log gives the cause",
    ),
    Fault.THREAD_HANGS: (
        "a thread of the daemon does not respond",
        "the log names the thread: check disk and bus; the watchdog restarts the daemon if a computation does not end",
    ),
}
"""Meaning and remedy of every fault."""


def describe_over(fault: Fault, seconds: float) -> str:
    """Log line of a fault that is over, with its duration in s."""
    return f"over: fault {int(fault)}: {FAULTS[fault][0]}. It lasted {seconds:.0f} s"


def describe_consequence(fault: Fault, cause: Fault) -> str:
    """Log line of a fault that follows from another one."""
    return f"fault {int(fault)} follows from fault {int(cause)}: {FAULTS[fault][0]}"
