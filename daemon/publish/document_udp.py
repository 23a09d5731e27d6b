"""Generator of the page `docs/udp.md` from the tables."""

from __future__ import annotations

from typing import Final

from daemon.integrity.input_monitor import LATE_S
from daemon.publish import udp_subscriptions
from daemon.publish.document_tables import NOT_KNOWN, NOTICE, layout_rows, table
from daemon.publish.modbus import integrity_block, lights_block, registers
from hal.net import input_codec, inputs
from hal.net.rx_timestamp import MAX_AGE_S


def udp_page() -> str:
    """The text of `docs/udp.md`."""
    crc = registers.DATAGRAM_SIZE - 4
    rows = [
        ("0", "`magic`", "4 bytes", "", "", f'"{registers.DATAGRAM_MAGIC.decode()}".'),
        ("4", "`version`", "uint16", "", "", f"{registers.VERSION}."),
        ("6", "`length`", "uint16", "", "", f"Bytes of the whole datagram, {registers.DATAGRAM_SIZE} or more; "
         f"{registers.SMALLEST_DATAGRAM} from programs that knew no lights, which sent no more than `devices`; "
         f"{registers.TRUST_OFFSET + 4} from those that sent no more than `light_age`."),
        *layout_rows(registers.BODY, registers.BODY_OFFSET, 2),
        *layout_rows(lights_block.TAIL, registers.TAIL_OFFSET, 2),
        *layout_rows(integrity_block.TAIL, registers.TRUST_OFFSET, 2),
        ("length - 4", "`crc`", "uint32", "", "", f"CRC-32 of all bytes before it (at {crc} in this version)."),
    ]  # fmt: skip
    return f"""{NOTICE}
# UDP

## Pose datagrams

After each cycle the daemon sends one datagram to every `pose.receivers` entry: a computer (`192.168.0.20:5600`), a
multicast group (`239.255.0.7:5600`), or whoever subscribes (`*:5601`, see below). Datagrams to a group stay on the
local network. They leave by the interface whose address `bind` is, so with 127.0.0.1 they stay on this computer; with
0.0.0.0 or `::` by the one that the system's routes name; an IPv6 group may name its own (`[ff15::42%eth0]:5600`). The
loopback interface has no IPv6 groups. Little-endian, every value naturally aligned, CRC-32 as in zlib and
IEEE 802.3. Nothing is repeated: a lost datagram is followed by a newer one. Readers go by `length`: a
later version of the program may append values under the same `version` number. A reference reader in C is
`tools/clients/listen_pose.c`.

{NOT_KNOWN}

{table(("byte", "name", "type", "step", "not known", "meaning"), rows)}

States, reasons, faults, the numbers of `light_fix` and the bits of `flags`, `devices` and `witnesses` are those of
[Modbus](modbus.md), where every single link can be read too.

{_subscribing()}
## Odometry and IMU datagrams

With `odometry.port` set, the daemon takes wheel odometry and gyro readings as datagrams on that port. Little-endian,
CRC-32 as above. A reference sender is `tools/clients/send_odometry.py`.

{table(("byte", "type", "meaning"), _input_rows())}

* Odometry is cumulative, so a lost datagram loses nothing; one that was overtaken is dropped, and so is a repeated one.
* A sender that restarts draws a new `session` (or is silent for {inputs.SESSION_TIMEOUT_S:g} s) and may begin again
  at pose 0: the daemon carries on without a jump. While one sender is heard, another session on the port is ignored;
  where that lasts for more than a second the log says whose.
* The time of a reading is the kernel's time of arrival. Where none has come for longer than usual although the sender's
  own `time` has gone on as usual, those that come at last were held up: they are dated back by that, up to
  {MAX_AGE_S:g} s. So are readings that are sent several at a time, each with the `time` it was taken at. Any clock does
  for that; where it stands, is set or runs fast or slow, the arrival counts. Readings that keep coming more than
  {LATE_S:g} s late are told (ODOMETRY_GAPS).
* A sender on the same computer does better: it sets bit 0 of `flags` and puts CLOCK_MONOTONIC into `time`; a time in
  the future or more than {MAX_AGE_S:g} s old is not believed.
* Values that are not finite or beyond {input_codec.LARGEST:g}, a wrong length or a wrong CRC are dropped; the
  log says what is wrong, and whose it is, where that lasts.
"""


def _subscribing() -> str:
    return f"""## Subscribing

With `*:PORT` among `pose.receivers`, a program gets pose datagrams by asking for them on that port:
{udp_subscriptions.SIZE} bytes, little-endian, both ways. A reference client is `tools/clients/subscribe_pose.py`.

{table(("byte", "type", "meaning"), _subscription_rows())}

1. Send ASK with the lease that is wanted and cookie 0. The answer is COOKIE.
2. Send ASK again with that cookie. The answer is GRANTED with the lease in seconds, {udp_subscriptions.LONGEST_LEASE_S}
   at most, or FULL: there are never more than {udp_subscriptions.SUBSCRIBERS} subscribers. Pose datagrams come to the
   socket that asked, from the port that was asked.
3. Ask again with the cookie of the last answer before the lease is over, best after a third of it; if the answer is
   COOKIE, repeat with the new one. A lease of 0 ends it.

Nobody can have datagrams sent to another's address, because only that one sees the cookie; an answer is never larger
than what asked for it. Addresses that are not in `allow` get none.

{table(("`status`", "name", "meaning"), _status_rows())}
"""


_STATUSES: Final[dict[udp_subscriptions.Status, str]] = {
    udp_subscriptions.Status.ASK: "client: send me pose datagrams for `lease` seconds; 0: no more",
    udp_subscriptions.Status.COOKIE: "daemon: ask again with this cookie",
    udp_subscriptions.Status.GRANTED: "daemon: for `lease` seconds from now",
    udp_subscriptions.Status.FULL: "daemon: there are as many subscribers as can be; try later",
    udp_subscriptions.Status.ENDED: "daemon: no more are sent",
}


def _status_rows() -> list[tuple[str, ...]]:
    return [(str(status.value), status.name, _STATUSES[status]) for status in udp_subscriptions.Status]


def _subscription_rows() -> list[tuple[str, ...]]:
    return [
        ("0", "4 bytes", f'`magic`: "{udp_subscriptions.MAGIC.decode()}".'),
        ("4", "uint16", f"`version`: {udp_subscriptions.VERSION}."),
        ("6", "uint16", f"`length` of the whole datagram: {udp_subscriptions.SIZE}."),
        ("8", "uint16", "`status`."),
        ("10", "uint16", "`lease` in seconds."),
        ("12", "uint64", "`cookie`: 0 before the first is known."),
        ("20", "uint32", "`crc`: CRC-32 of all bytes before it."),
    ]


def _input_rows() -> list[tuple[str, ...]]:
    return [
        ("0", "4 bytes", '`magic`: "LUOD" odometry, "LUIM" IMU.'),
        ("4", "uint16", f"`version`: {input_codec.VERSION}."),
        (
            "6",
            "uint16",
            f"`length` of the whole datagram: {input_codec.ODOMETRY_SIZE} odometry, {input_codec.IMU_SIZE} IMU.",
        ),
        ("8", "uint32", "`session`: a random number drawn when the sender starts."),
        ("12", "uint32", "`seq`: one more with every datagram of this kind, wraps."),
        ("16", "uint32", "`flags`: bit 0: `time` is CLOCK_MONOTONIC of the daemon's own computer."),
        ("20", "uint32", "0."),
        ("24", "float64", "`time` of the reading in seconds, in the sender's clock."),
        ("32", "float64", "Odometry: `x`, m. IMU: `yaw_rate`, rad/s, counter-clockwise."),
        ("40", "float64", "Odometry: `y`, m."),
        ("48", "float64", "Odometry: `yaw`, rad, counter-clockwise, wrapped or not."),
        ("length - 4", "uint32", "`crc`."),
    ]
