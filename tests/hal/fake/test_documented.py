"""The vocabulary in the documentation is the vocabulary."""

from __future__ import annotations

import re
from pathlib import Path

from hal.fake.lidar_faults import LIDAR
from hal.fake.models import MODELS

PAGE = (Path(__file__).parents[3] / "docs" / "fake-devices.md").read_text(encoding="utf-8")


def test_every_word_has_its_row() -> None:
    rows = re.findall(r"^\| `(\w+)` \| (\w+) \| (.*) \| (.*) \|$", PAGE, re.MULTILINE)
    assert [row[0] for row in rows] == list(LIDAR)
    for name, kind, parameters, text in rows:
        word = LIDAR[name]
        assert (kind, text) == (word.kind, word.help)
        assert parameters == ", ".join(f"`{key}` {rule.default!r}" for key, rule in word.parameters.items())


def test_every_model_is_named() -> None:
    assert all(name in PAGE for name in MODELS)
