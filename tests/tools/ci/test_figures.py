import json
import math
from pathlib import Path

import numpy as np
import pytest

from tools.ci.figures import Figure, bounded, save, table


def test_a_bound_is_judged() -> None:
    assert bounded("a", 0.02, "m", "<= 0.022", "x").ok
    assert not bounded("a", 0.03, "m", "<= 0.022", "x").ok
    assert bounded("speed", 101.0, "x", ">= 100", "x").ok
    assert not bounded("nan never passes", math.nan, "m", "<= 1", "x").ok


def test_a_target_that_cannot_be_judged_is_refused() -> None:
    with pytest.raises(ValueError, match="must read"):
        bounded("a", 1.0, "m", "about 1", "x")


def test_saved_figures_read_back(tmp_path: Path) -> None:
    figures = [bounded("a", np.float64(1.0), "ms", "<= 2", "make bench"), Figure("b", np.float64(3.0), "MB")]
    loaded = json.loads(save("demo", figures, tmp_path / "new").read_text())
    assert [entry["name"] for entry in loaded] == ["a", "b"]
    assert loaded[0]["ok"] is True
    assert loaded[1]["ok"] is None
    assert "MISSED" not in table(figures)
