"""How rmw_zenoh, ROS 2's middleware over Zenoh, names and packs messages: pure, text and bytes.

After its design document (github.com/ros2/rmw_zenoh, docs/design.md, as of Jazzy and later): key expressions,
liveliness tokens from which `ros2 topic list` is made, and the attachment of every message. The payload is CDR
(`taps.ros.types`).
"""

from __future__ import annotations

import hashlib
import re
import struct
from dataclasses import dataclass
from typing import Final

ADMIN: Final = "@ros2_lv"
UNSUPPORTED: Final = "TypeHashNotSupported"
"""What Humble has in the place of a type's hash."""
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
    """A namespace as a person writes it, with a slash before and none behind.

    Raises:
        ValueError: ROS has no such names.
    """
    named = "/" + text.strip("/") if text.strip("/") else ""
    if not _NAMESPACE.fullmatch(named):
        raise ValueError(f"Expected a namespace of letters, digits and _, as in /agv1, got `{text}`")
    return named


def dds_name(kind: str) -> str:
    """``sensor_msgs/msg/LaserScan`` as DDS has it."""
    package, _, name = kind.split("/")
    return f"{package}::msg::dds_::{name}_"


def qos(latched: bool) -> str:
    """Quality of service as far as it differs from rmw_zenoh's default (reliable, volatile, keep last, 42)."""
    return ":1:,1:,:,:,," if latched else f"::,{DEPTH}:,:,:,,"


def attachment(number: int, t_ns: int, gid: bytes) -> bytes:
    """What goes with a message: its number from 1, when it was sent (ns since the Unix epoch), whose it is."""
    return _ATTACHMENT.pack(number, t_ns, _GID, gid)


def gid_of(token: str) -> bytes:
    """16 bytes that no other publisher has. rmw_zenoh takes XXH3 of the token; nobody compares the two."""
    return hashlib.blake2b(token.encode(), digest_size=_GID).digest()


def _mangled(name: str) -> str:
    return name.replace("/", "%") or "%"
