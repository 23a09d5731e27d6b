"""The example on the page about planning is what the command says."""

import shutil
from pathlib import Path

import pytest

from tools.docs import planshot

pytest.importorskip("matplotlib", reason="pip install 'lumiloop[plot]'")
DOCS = Path(__file__).parents[3] / "docs"


@pytest.mark.jit
def test_the_page_shows_what_the_command_says(tmp_path: Path) -> None:
    (tmp_path / "images").mkdir()
    shutil.copyfile(DOCS / "planning.md", tmp_path / "planning.md")
    assert planshot.main(["--docs", str(tmp_path)]) == 0
    assert (tmp_path / "planning.md").read_text() == (DOCS / "planning.md").read_text()
    assert (tmp_path / "images" / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_a_page_without_the_example_is_refused() -> None:
    with pytest.raises(ValueError, match="no example"):
        planshot.shown("# Planning\n", ["floor: 1 m2"])
