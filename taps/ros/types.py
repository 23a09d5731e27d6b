"""ROS 2 message types: definitions, construction, encoding (CDR, XCDR1 plain).

Standard types are those of Humble, which later releases read. Data without a standard type have a ``lumiloop_msgs``
type, whose definition is part of every file and connection.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

OWN: Final = {
    "lumiloop_msgs/msg/Raw": """# Bytes as they passed between the daemon and a device
std_msgs/Header header
string device
string kind
float64 rate
uint8 bits
uint8[] data
""",
    "lumiloop_msgs/msg/Link": """# One lamp in view; lamp_id -1: not clear which
uint16 code
int32 lamp_id
uint8 use
float64 strength
float64 residual
""",
    "lumiloop_msgs/msg/Lights": """# What lights alone say, without the laser; not a number where not known
std_msgs/Header header
uint8 fix
uint8 used
geometry_msgs/Pose2D pose
float64[3] sigma
uint32 blocks
uint32 blocks_lost
lumiloop_msgs/Link[] links
""",
    "lumiloop_msgs/msg/Loop": """# A loop closure; keyframes -1: not known
std_msgs/Header header
uint32 counter
int32 keyframe_new
int32 keyframe_old
uint8 reason
float64 residual
""",
    "lumiloop_msgs/msg/State": """# State, and how far the pose can be trusted; not a number: no bound
std_msgs/Header header
uint8 state
string state_name
string meaning
string remedy
float64 protection_level_m
bool alert
""",
}

STORE: Final = get_typestore(Stores.ROS2_HUMBLE)
for _name, _text in OWN.items():
    STORE.register(get_types_from_msg(_text, _name))


def make(name: str, /, **fields: Any) -> Any:  # classes are made at run time from the definitions
    """A message of a type, by its full name as in ``sensor_msgs/msg/LaserScan``."""
    return STORE.types[name](**fields)


def encode(kind: str, message: Any) -> bytes:
    """A message as CDR, with its four bytes of encapsulation."""
    return bytes(STORE.serialize_cdr(message, kind))


def definition(kind: str) -> str:
    """The definition of a type with all its parts, in MCAP's schema encoding ``ros2msg``."""
    text, _ = STORE.generate_msgdef(kind, ros_version=2)
    return text


def time(t_utc: float) -> Any:
    """A time (s since the Unix epoch) as a message."""
    whole, rest = divmod(nanoseconds(t_utc), 10**9)
    return make("builtin_interfaces/msg/Time", sec=whole, nanosec=rest)


def nanoseconds(t_utc: float) -> int:
    """A time in ns since the Unix epoch, rounded to microseconds, clipped to the range of ROS."""
    return min(max(round(t_utc * 1e6) * 1000, 0), (2**31 - 1) * 10**9)


def header(t_utc: float, frame: str) -> Any:
    """Time and frame."""
    return make("std_msgs/msg/Header", stamp=time(t_utc), frame_id=frame)


def quaternion(yaw: float, inverted: bool = False) -> Any:
    """A rotation about z (rad); ``inverted``: preceded by half a turn about x, for an upside-down mount."""
    s, c = float(np.sin(yaw / 2)), float(np.cos(yaw / 2))
    x, y, z, w = (c, s, 0.0, 0.0) if inverted else (0.0, 0.0, s, c)
    return make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def pose(x: float, y: float, yaw: float) -> Any:
    """A planar pose (m, m, rad)."""
    point = make("geometry_msgs/msg/Point", x=x, y=y, z=0.0)
    return make("geometry_msgs/msg/Pose", position=point, orientation=quaternion(yaw))


def transform(t_utc: float, parent: str, child: str, T: tuple[float, float, float], inverted: bool = False) -> Any:
    """``T_parent_child``."""
    moved = make("geometry_msgs/msg/Vector3", x=T[0], y=T[1], z=0.0)
    turned = make("geometry_msgs/msg/Transform", translation=moved, rotation=quaternion(T[2], inverted))
    return make(
        "geometry_msgs/msg/TransformStamped", header=header(t_utc, parent), child_frame_id=child, transform=turned
    )


def planar(covariance: tuple[float, float, float, float, float, float]) -> npt.NDArray[np.float64]:
    """(xx, xy, yy, x-yaw, y-yaw, yaw-yaw) as 36 numbers over x, y, z, roll, pitch, yaw, row by row."""
    P = np.zeros((6, 6))
    for value, (i, j) in zip(covariance, ((0, 0), (0, 1), (1, 1), (0, 5), (1, 5), (5, 5)), strict=True):
        P[i, j] = P[j, i] = value
    return P.ravel()
