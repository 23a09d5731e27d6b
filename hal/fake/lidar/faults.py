"""The vocabulary of the fake lidar's faults."""

from __future__ import annotations

from hal.fake.faults.orders import Parameter, Vocabulary, Word
from hal.fake.lidar.commands import PARAMETERS, SINGLES, STREAMS
from hal.fake.lidar.output_line import MAX_JOIN
from hal.fake.lidar.scip_encoder import MAX_3

ON = {"on": Parameter("scans", choices=("scans", "replies", "all"))}
COMMANDS = tuple(sorted({*PARAMETERS, *STREAMS, *SINGLES, "SC"}))
"""As returned by `hal.fake.lidar.commands.letters`; SC is ``SCIP2.0``."""
REFUSALS = ("0E", "10", "0M", "0L", "0A", "0C", "0F")
PP_KEYS = ("MODL", "DMIN", "DMAX", "ARES", "AMIN", "AMAX", "AFRT", "SCAN")

LIDAR: Vocabulary = {
    # the general words
    "off": Word("no power: the connection drops (a serial line stops), then a restart", "lasts"),
    "stuck": Word("the same scan with the same stamp repeatedly", "strikes"),
    "garbage": Word("random bytes of the same length instead", "strikes", ON),
    "wrong": Word(
        "valid ranges off by `by_mm`, with correct sums", "strikes", {"by_mm": Parameter(500, -MAX_3, MAX_3)}
    ),
    "slow": Word("the motor takes `factor` times the period", "lasts", {"factor": Parameter(2.0, 0.1, 100.0)}),
    "delayed": Word("everything arrives `by_s` later, in order", "lasts", {"by_s": Parameter(0.3, 0.0, 60.0)}),
    "intermittent": Word("scans are lost on the way", "strikes", ON, share=0.5),
    # damage to bytes
    "bit_flip": Word(
        "one bit of one byte of `part` is inverted",
        "strikes",
        ON
        | {"part": Parameter("data", choices=("echo", "status", "stamp", "data", "sum")), "bit": Parameter(-1, -1, 7)},
    ),
    "drop_byte": Word("one byte is lost", "strikes", ON),
    "drop_line": Word("one data line is lost", "strikes", ON),
    "duplicate_line": Word("one data line comes twice", "strikes", ON),
    "cut_frame": Word("breaks off in the middle; the next data follow at once", "strikes", ON),
    "alien_reply": Word(
        "another command's reply in the middle of a scan",
        "strikes",
        {"command": Parameter("II", choices=("VV", "PP", "II"))},
    ),
    # content of a scan
    "status": Word("a scan's 99 is another status, without data", "strikes", {"code": Parameter(50, 0, 99)}),
    "frozen_stamp": Word("the stamp stops while ranges continue", "strikes"),
    "stamp_jump": Word("stamps are off by `by_ms`", "strikes", {"by_ms": Parameter(-5000, -(1 << 24), 1 << 24)}),
    "wrong_steps": Word(
        "`by` steps more or fewer than requested, with correct sums", "strikes", {"by": Parameter(-1, -1000, 1000)}
    ),
    "codes": Word(
        "a share of the beams reports `value` (an error code, or 65533: no return)",
        "strikes",
        {"value": Parameter(65533, 0, MAX_3), "beams": Parameter(0.3, 0.0, 1.0)},
    ),
    "dark": Word("all intensities are 0", "strikes"),
    # the line
    "silence": Word("the sensor sends nothing at all", "lasts"),
    "stall": Word("nothing arrives, then everything at once", "lasts"),
    "hangup": Word("the connection drops and cannot be opened; the sensor keeps its power", "lasts"),
    "chunks": Word(
        "replies arrive in pieces of `piece` bytes (0: whole), the last LF apart, or `join` scans at once",
        "lasts",
        {"piece": Parameter(1, 0, 65536), "split_end": Parameter(False), "join": Parameter(1, 1, MAX_JOIN)},
    ),
    "baud": Word("an RS-232 sensor sends at another rate", "once", {"rate": Parameter(57600, 1200, 750000)}),
    "inject": Word("another program writes `text` to the sensor", "once", {"text": Parameter("AT\r")}),
    # commands
    "ignore": Word(
        "`command` is neither executed nor answered", "strikes", {"command": Parameter("QT", choices=COMMANDS)}
    ),
    "no_reply": Word(
        "`command` is executed, but its acknowledgement is lost",
        "strikes",
        {"command": Parameter("MD", choices=COMMANDS)},
    ),
    "denied": Word(
        "`command` is answered `status`, but not executed",
        "strikes",
        {"command": Parameter("VV", choices=COMMANDS), "status": Parameter("0E", choices=REFUSALS)},
    ),
    "not_ready": Word(
        "for `by_s` after each start, no measurement: answered `status`; `mode` is then the mode of II",
        "lasts",
        {
            "by_s": Parameter(30.0, 0.0, 3600.0),
            "status": Parameter("0M", choices=REFUSALS),
            "mode": Parameter(""),
        },
    ),
    "text_sum": Word(
        "text lines are summed with the semicolon (`whole`) or up to `<-` (`mark`)",
        "lasts",
        {"variant": Parameter("whole", choices=("whole", "mark"))},
    ),
    "vendor": Word("the vendor's name in VV is `text`, in Latin-1", "lasts", {"text": Parameter("H\xf6kuy\xf6")}),
    "parameter": Word(
        "PP gives `value` for `key`",
        "lasts",
        {"key": Parameter("SCAN", choices=PP_KEYS), "value": Parameter("2400[rpm]")},
    ),
    "semicolon": Word("the firmware text holds a semicolon", "lasts"),
    "dmax": Word("PP reports another DMAX", "lasts", {"value": Parameter(MAX_3, 1)}),
    "trouble": Word("II reports a fault in words", "lasts", {"text": Parameter("Trouble!! Error No. =[00->33]")}),
    # power and state
    "reset": Word("brown-out: starts up again, connection kept", "once"),
    "boot_delay": Word("starting up takes `by_s` longer", "lasts", {"by_s": Parameter(3.0, 0.0, 3600.0)}),
    "scip1": Word("uses SCIP 1.1 now and after every start", "lasts"),
    "set_clock": Word("the clock shows `ms`", "once", {"ms": Parameter((1 << 24) - 1216, 0, (1 << 24) - 1)}),
    "error": Word("stops with status `code` and refuses all but RB", "once", {"code": Parameter(70, 0, 99)}),
    "verify": Word("stops with 21 to check itself, resumes with 98 when lifted", "lasts"),
}
"""By word. ``off stuck garbage wrong slow delayed intermittent`` are common to all devices."""
