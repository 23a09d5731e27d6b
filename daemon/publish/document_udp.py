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
         f"{registers.SMALLEST_DATAGRAM}: ends with `devices`; {registers.TRUST_OFFSET + 4}: ends with `light_age`."),
        *layout_rows(registers.BODY, registers.BODY_OFFSET, 2, notes=False),
        *layout_rows(lights_block.TAIL, registers.TAIL_OFFSET, 2, notes=False),
        *layout_rows(integrity_block.TAIL, registers.TRUST_OFFSET, 2, notes=False),
        ("length - 4", "`crc`", "uint32", "", "", f"CRC-32 of all bytes before it (at {crc} in this version)."),
    ]  # fmt: skip
    return f"""{NOTICE}
# Datagrams

## Pose datagrams

After each cycle the daemon sends one datagram to every entry of `pose.receivers`:

* a computer: `192.168.0.20:5600`;
* a multicast group: `239.255.0.7:5600`. It stays on the local network;
* every subscriber: `*:5601` ([below](#subscribing)).

Multicast leaves by the interface that has the address `bind`: with 127.0.0.1 it stays on this computer. With 0.0.0.0 or
`::` the system's routes decide. An IPv6 group may name its interface: `[ff15::42%eth0]:5600`. The loopback interface
has no IPv6 groups.

Values are little-endian and naturally aligned. The CRC-32 is that of zlib and IEEE 802.3. The daemon repeats nothing: a
newer datagram follows a lost one. Read by `length`: a later version may append values under the same `version`. A
reference reader in C is `tools/clients/listen_pose.c`.

{NOT_KNOWN}

{table(("byte", "name", "type", "step", "not known", "meaning"), rows)}

`state`, `reason` and `fault`: [States, reasons, faults](codes.md). The numbers of `light_fix`, the bits of `flags`,
`devices` and `witnesses`, and the notes on each value are those of [Modbus](modbus.md). There you can also read every
single link.

{_subscribing()}
## Odometry and IMU datagrams

With `odometry.port` set, the daemon takes wheel odometry and gyro readings as datagrams on that port. They are
little-endian with the same CRC-32. A reference sender is `tools/clients/send_odometry.py`.

{table(("byte", "type", "meaning"), _input_rows())}

* Odometry is cumulative, so a lost datagram loses nothing. The daemon drops repeated and overtaken ones.
* A sender that restarts draws a new `session`, or is silent for {inputs.SESSION_TIMEOUT_S:g} s. It may begin again at
  pose 0; the daemon continues without a jump.
* The daemon takes one sender at a time. If another session sends for more than a second, the log names its address.
* The time of a reading is the kernel's time of arrival. The daemon corrects delays from the sender's `time`, up to
  {MAX_AGE_S:g} s: of datagrams that were held up, and of readings that are sent several at a time. Any clock will do.
  Where that clock stops, is set, or runs fast or slow, the time of arrival counts.
* Readings that keep arriving more than {LATE_S:g} s late are a fault (ODOMETRY_GAPS).
* A sender on the same computer sets bit 0 of `flags` and puts CLOCK_MONOTONIC into `time`. The daemon does not believe
  a time in the future or more than {MAX_AGE_S:g} s old.
* The daemon drops values that are not finite or exceed {input_codec.LARGEST:g}, a wrong length and a wrong CRC. If that
  lasts, the log states what is wrong and names the sender.
"""


def _subscribing() -> str:
    return f"""## Subscribing

With `*:PORT` in `pose.receivers`, a program subscribes to pose datagrams on that port. Request and answer have
{udp_subscriptions.SIZE} bytes, little-endian. A reference client is `tools/clients/subscribe_pose.py`.

{table(("byte", "type", "meaning"), _subscription_rows())}

1. Send ASK with the lease you want and cookie 0. The answer is COOKIE.
2. Send ASK again with that cookie. The answer is GRANTED with the lease in seconds, {udp_subscriptions.LONGEST_LEASE_S}
   at most, or FULL: there are never more than {udp_subscriptions.SUBSCRIBERS} subscribers. Pose datagrams then come to
   your socket, from the port that you asked.
3. Ask again with the cookie of the last answer before the lease ends, best after a third of it. If the answer is
   COOKIE, repeat with the new one. A lease of 0 ends the subscription.

Nobody can direct datagrams to another address, because only that address receives the cookie. An answer is never larger
than its request. Addresses that are not in `allow` get none.

{table(("`status`", "name", "meaning"), _status_rows())}
"""


_STATUSES: Final[dict[udp_subscriptions.Status, str]] = {
    udp_subscriptions.Status.ASK: "client: send pose datagrams for `lease` seconds; 0: stop",
    udp_subscriptions.Status.COOKIE: "daemon: ask again with this cookie",
    udp_subscriptions.Status.GRANTED: "daemon: subscribed for `lease` seconds from now",
    udp_subscriptions.Status.FULL: "daemon: the number of subscribers is at its limit; try later",
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
