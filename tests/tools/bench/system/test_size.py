"""What is weighed: every extra that a robot runs, at the locked versions."""

from __future__ import annotations

import re
from pathlib import Path

from tools.bench.system.size import extras, locked, size_mb


def test_all_that_a_robot_s_extras_ask_for_is_locked(tmp_path: Path) -> None:
    assert {"view", "mcap", "foxglove"} <= set(extras())
    assert not {"test", "bench", "plot"} & set(extras())
    lines = locked(tmp_path).read_text().splitlines()
    assert all(re.fullmatch(r"[A-Za-z0-9_.-]+==[^\s\\]+( ;.*)?", line) for line in lines)
    pinned = {line.partition("==")[0].lower() for line in lines}
    wanted = {re.split(r"[<>=\[ ]", one)[0].lower() for all_of_it in extras().values() for one in all_of_it}
    assert wanted <= pinned


def test_files_are_weighed_and_links_are_not(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "file").write_bytes(bytes(3_000_000))
    (tmp_path / "link").symlink_to(tmp_path / "a" / "file")
    (tmp_path / "folder").symlink_to(tmp_path / "a")
    assert size_mb(tmp_path) == 3.0
