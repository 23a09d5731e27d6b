"""rmw_zenoh's convention: names against the examples of its design document, attachments against Zenoh's own reader."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

pytest.importorskip("rosbags", reason="pip install 'lumiloop[zenoh]'")
from taps.ros import rmw_zenoh, types
from taps.ros.messages import TOPICS

STRING = "std_msgs/msg/String"
HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
SESSION = "8b20917502ee955ac4476e0266340d5c"


def test_keys_are_those_of_the_design_document() -> None:
    assert types.STORE.hash_rihs01(STRING) == HASH
    plain, spaced = rmw_zenoh.Node(0, SESSION, "talker"), rmw_zenoh.Node(0, SESSION, "talker", "/robot1")
    assert plain.key("/chatter", STRING, HASH) == f"0/chatter/std_msgs::msg::dds_::String_/{HASH}"
    assert spaced.key("/chatter", STRING, HASH) == f"0/robot1/chatter/std_msgs::msg::dds_::String_/{HASH}"


def test_tokens_are_those_of_the_design_document() -> None:
    node = rmw_zenoh.Node(2, SESSION, "talker")
    assert node.token() == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%/talker"
    made = node.publisher(10, "/chatter", STRING, HASH, latched=False)
    wanted = f"@ros2_lv/2/{SESSION}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{HASH}/::,7:,:,:,,"
    assert made == wanted.replace(",7:", f",{rmw_zenoh.DEPTH}:")
    spaced = rmw_zenoh.Node(2, SESSION, "talker", "/a/b").publisher(1, "/tf_static", STRING, HASH, latched=True)
    assert spaced.split("/")[7:] == [
        "%a%b",
        "talker",
        "%a%b%tf_static",
        "std_msgs::msg::dds_::String_",
        HASH,
        ":1:,1:,:,:,,",
    ]
    assert rmw_zenoh.Node(2, SESSION, "talker", "/a/b").token() == f"@ros2_lv/2/{SESSION}/0/0/NN/%/%a%b/talker"


@pytest.mark.parametrize(("text", "named"), [("", ""), ("/", ""), ("agv1", "/agv1"), ("/a/b_2/", "/a/b_2")])
def test_namespaces(text: str, named: str) -> None:
    assert rmw_zenoh.namespace_of(text) == named


@pytest.mark.parametrize("text", ["agv-1", "/1", "a//b", "a b", "a/*", "%"])
def test_names_that_ros_does_not_have_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match="letters, digits and _"):
        rmw_zenoh.namespace_of(text)


int64 = st.integers(-(2**63), 2**63 - 1)


@given(int64, int64, st.binary(min_size=16, max_size=16))
def test_an_attachment_is_read_by_zenohs_own_deserialiser(number: int, t_ns: int, gid: bytes) -> None:
    zenoh = pytest.importorskip("zenoh", reason="pip install 'lumiloop[zenoh]'")
    packed = rmw_zenoh.attachment(number, t_ns, gid)
    assert len(packed) == 33
    kind = tuple[zenoh.ext.Int64, zenoh.ext.Int64, bytes]
    assert zenoh.ext.z_deserialize(kind, zenoh.ZBytes(packed)) == (number, t_ns, gid)
    assert struct.unpack("<qq", packed[:16]) == (number, t_ns)


def test_publishers_have_names_of_their_own() -> None:
    node = rmw_zenoh.Node(0, SESSION, "lumiloop")
    gids = {
        rmw_zenoh.gid_of(node.publisher(k, topic, about.kind, HASH, False))
        for k, (topic, about) in enumerate(TOPICS.items())
    }
    assert len(gids) == len(TOPICS)
    assert {len(gid) for gid in gids} == {16}


def test_a_gid_is_the_hash_that_rmw_zenoh_makes_of_the_token() -> None:
    """Low half first, each little-endian, as its `liveliness_utils.cpp` copies them (value made by python-xxhash)."""
    token = (
        "@ros2_lv/0/4f1c6b0d9a3e2f7785c1d0e9ab34cd56/0/1/MP/%/%agv1/lumiloop/%agv1%pose/"
        "geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/"
        "RIHS01_26432f9803e43727d3c8f668d5fdb3c630f548af631e2f4e31382371bfea3b6e/::,10:,:,:,,"
    )
    assert rmw_zenoh.gid_of(token).hex() == "d77c1064ce794ac009401af03369e029"
