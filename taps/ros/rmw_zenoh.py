"""The rmw_zenoh conventions: key expressions, liveliness tokens and attachments of ROS 2 messages. Pure, no I/O.

Source: its design document (github.com/ros2/rmw_zenoh, docs/design.md, as of Jazzy and later). `ros2 topic list` reads
the liveliness tokens. The payload is CDR (`taps.ros.types`).
"""

from __future__ import annotations

import re
import struct
from dataclasses import dataclass
from typing import Final

from taps.ros.xxh3 import xxh3_128

ADMIN: Final = "@ros2_lv"
UNSUPPORTED: Final = "TypeHashNotSupported"
"""Humble's placeholder for a type's hash."""
DEPTH: Final = 10
NODE_ID: Final = 0
_ATTACHMENT: Final = struct.Struct("<qqB16s")
_GID: Final = 16
_NAMESPACE: Final = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)*")


@dataclass(frozen=True, slots=True)
class Node:
    """A node of ROS.

    Attributes:
        domain: ROS_DOMAIN_ID. session: Zenoh's ID of the session. name: of the node.
        namespace: as in ``/agv1``; empty: none.
    """

    domain: int
    session: str
    name: str
    namespace: str = ""

    def token(self) -> str:
        """The liveliness token of the node."""
        return self._token(NODE_ID, "NN")

    def publisher(self, number: int, topic: str, kind: str, hashed: str, latched: bool) -> str:
        """The liveliness token of a publisher; ``latched``: transient local."""
        named = _mangled(self.namespace + topic)
        return f"{self._token(number, 'MP')}/{named}/{dds_name(kind)}/{hashed}/{qos(latched)}"

    def key(self, topic: str, kind: str, hashed: str) -> str:
        """The key expression of a topic's messages."""
        return f"{self.domain}{self.namespace}{topic}/{dds_name(kind)}/{hashed}"

    def others(self) -> str:
        """The tokens of all nodes of this name and namespace."""
        return f"{ADMIN}/{self.domain}/*/*/*/NN/*/{_mangled(self.namespace)}/{self.name}"

    def _token(self, number: int, entity: str) -> str:
        place = f"{ADMIN}/{self.domain}/{self.session}/{NODE_ID}/{number}/{entity}"
        return f"{place}/%/{_mangled(self.namespace)}/{self.name}"


def session_of(token: str) -> str:
    """Zenoh's ID of the session that declared a liveliness token."""
    return token.split("/")[2]


def namespace_of(text: str) -> str:
    """Normalise a namespace: one leading slash, none at the end.

    Raises:
        ValueError: not a valid ROS name.
    """
    named = "/" + text.strip("/") if text.strip("/") else ""
    if not _NAMESPACE.fullmatch(named):
        raise ValueError(f"Expected a namespace of letters, digits and _, as in /agv1, got `{text}`")
    return named


def dds_name(kind: str) -> str:
    """The DDS name of a type such as ``sensor_msgs/msg/LaserScan``."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def qos(latched: bool) -> str:
    """Quality of service where it differs from rmw_zenoh's default (reliable, volatile, keep last, 42)."""
    return ":1:,1:,:,:,," if latched else f"::,{DEPTH}:,:,:,,"


def attachment(number: int, t_ns: int, gid: bytes) -> bytes:
    """Attachment of a message: number from 1, time of sending (ns since the Unix epoch), publisher's ID."""
    return _ATTACHMENT.pack(number, t_ns, _GID, gid)


def gid_of(token: str) -> bytes:
    """GID of the entity with this liveliness token, 16 bytes: XXH3 of the token, both halves little-endian.

    A subscriber of rmw_zenoh computes it from the token that it sees, and finds it in each message's attachment.
    """
    return xxh3_128(token.encode()).to_bytes(_GID, "little")


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"
