"""Changes of values in the text of a configuration: the value changes, everything else stays."""

import tomllib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from daemon.config import loader
from daemon.config.edit import CannotEdit, with_values
from daemon.config.errors import options

TEXT = """\
# The robot in hall 3.
name = "a#b"    # not "a"

[lidar]         # on the mast
device = "auto"
mount = { x = 1.0, yaw = 90 }

[map]
folder = \"\"\"
[modbus]
port = 7\"\"\"   # a text over lines

[pose]
receivers = [
    "10.0.0.1:5600",  # the PLC
]

[modbus]
# port (whole number)
# port = 1502
"""


@pytest.mark.parametrize(
    ("path", "value", "line"),
    [
        ("name", "r2", 'name = "r2"    # not "a"'),
        ("lidar.device", "none", 'device = "none"'),
        ("lidar.mount.x", 0.25, "mount = { x = 0.25, yaw = 90 }"),
        ("lidar.mount.y", 0.5, "mount = { x = 1.0, yaw = 90, y = 0.5 }"),
        ("map.folder", "/maps", 'folder = "/maps"   # a text over lines'),
        ("pose.receivers", ["*:5601"], 'receivers = ["*:5601"]'),
        ("modbus.port", 502, "# port = 1502\nport = 502"),
        ("odometry.port", 5601, "[odometry]\nport = 5601"),
        ("bind", "0.0.0.0", 'bind = "0.0.0.0"'),
    ],
)
def test_one_value_changes_and_comments_stay(path: str, value: object, line: str) -> None:
    changed = with_values(TEXT, {path: value})
    assert f"{line}\n" in changed
    tree = tomllib.loads(changed)
    for key in path.split("."):
        tree = tree[key]
    assert tree == value
    for comment in ("# The robot in hall 3.\n", "# on the mast", '# not "a"', "# port (whole number)", "over lines"):
        assert comment in changed
    kept = [text for text in TEXT.splitlines() if text.startswith("#")]
    assert [text for text in changed.splitlines() if text in kept][: len(kept)] == kept


def test_a_file_without_a_line_end_and_an_empty_one() -> None:
    assert with_values('name = "a"', {"modbus.port": 1}) == 'name = "a"\n\n[modbus]\nport = 1\n'
    assert with_values("", {"name": "a", "lidar.mount.x": 1.5}) == 'name = "a"\n\n[lidar.mount]\nx = 1.5\n'


@pytest.mark.parametrize("text", ["map = 3\n", '"odd key" = 1\n["odd key 2"]\nmap = 1\n[[map]]\nx = 1\n'])
def test_what_cannot_be_changed_is_refused(text: str) -> None:
    with pytest.raises(CannotEdit):
        with_values(text, {"map.folder": "/maps"})


@given(st.lists(st.sampled_from(options()), min_size=1, max_size=4, unique_by=lambda option: option.path))
def test_any_keys_can_be_set_in_the_template(chosen: list[loader.Option]) -> None:
    changed = with_values(loader.template(), {option.path: option.example for option in chosen})
    assert [line for line in loader.template().splitlines() if line not in changed.splitlines()] == []
    tree = tomllib.loads(changed)
    for option in chosen:
        found = tree
        for key in option.path.split("."):
            found = found[key]
        assert loader.value_text(found) == loader.value_text(option.example)
