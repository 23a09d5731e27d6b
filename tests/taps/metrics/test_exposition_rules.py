"""The metrics by Prometheus' rules: `promtool check metrics` where it is installed, and its rules one by one.

Rules: prometheus.io/docs/instrumenting/exposition_formats and /writing_exporters, checked by client_golang's promlint.
"""

from __future__ import annotations

import re
import shutil
import subprocess
from typing import Any

import pytest

from daemon.publish.stream.messages import (
    Condition,
    CycleTiming,
    Fault,
    Faults,
    Hello,
    Lights,
    Link,
    Pose,
    Statistics,
    Trust,
)
from daemon.snapshot import Part, Stage
from taps.metrics.metrics import Latest, exposition

families = pytest.importorskip("prometheus_client.parser").text_string_to_metric_families

SPREAD = (900, 1500, 2000)
TYPES = ("counter", "gauge", "histogram", "summary", "untyped")
ABBREVIATED = ("s", "ms", "us", "ns", "sec", "b", "kb", "mb", "gb", "m", "h", "d", "hz", "rad", "deg")


def everything() -> Latest:
    """The latest messages with a value in every field; two links of one lamp, as of twins."""
    latest = Latest()
    pose = Pose(
        seq=1, t_mono=1.0, t_sent=1.0, t_utc=1.7e9, state=3, state_name="TRACKING", reason=0, pose=(1.0, 2.0, 0.5),
        covariance=(1.0, 0.0, 1.0, 0.0, 0.0, 1.0), scan_rate=40.0, trust=Trust(horizontal_m=0.1),
        pulse=CycleTiming(cycle=SPREAD, late=SPREAD, stages=(SPREAD,) * len(Stage)),
        condition=Condition(restarts=(1,) * len(Part)),
    )  # fmt: skip
    twins = tuple(Link(code=5, lamp_id=12, residual=residual) for residual in (0.1, 0.2))
    counters = {name: 3 for name in Statistics.__struct_fields__ if name not in ("t_mono", "uptime", "memory_mb")}
    for message in (
        Hello(schema=1, name='agv "7"\\\n', pid=1),
        pose,
        Lights(t_mono=1.0, links=twins),
        Faults(present=(Fault(fault=104, meaning="no valid scan"),)),
        Statistics(t_mono=1.0, uptime=5.0, memory_mb=99.5, **counters),
    ):
        latest.update(message, 1.0)
    return latest


def described(text: str) -> dict[str, str]:
    """Type of each family, by its TYPE line."""
    return dict(re.findall(r"^# TYPE (\S+) (\S+)$", text, re.MULTILINE))


@pytest.mark.parametrize("now", [1.0, 60.0], ids=["all", "daemon silent"])
def test_promtool_accepts_the_page(now: float) -> None:
    if (promtool := shutil.which("promtool")) is None:
        pytest.skip("promtool is not installed (Debian: apt-get install prometheus)")
    done = subprocess.run(
        [promtool, "check", "metrics"], input=exposition(everything(), now), text=True, capture_output=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_each_family_has_one_help_and_one_type_before_its_samples() -> None:
    text = exposition(everything(), 1.0)
    assert text.endswith("\n")
    seen: list[str] = []
    for line in text.splitlines():
        if line.startswith("# HELP "):
            name, _, what = line.removeprefix("# HELP ").partition(" ")
            assert what.strip()
            seen.append(name)
        elif line.startswith("# TYPE "):
            assert line.split(" ")[2] == seen[-1]
        else:
            assert re.split(r"[{ ]", line)[0] == seen[-1]
    assert len(seen) == len(set(seen)) == len(described(text))


def test_no_series_is_there_twice() -> None:
    series = [line.rpartition(" ")[0] for line in exposition(everything(), 1.0).splitlines() if line[0] != "#"]
    assert len(series) == len(set(series))


@pytest.mark.parametrize(("name", "kind"), described(exposition(everything(), 1.0)).items())
def test_names_follow_the_type(name: str, kind: str) -> None:
    words = name.split("_")
    assert re.fullmatch(r"lumiloop(_[a-z0-9]+)+", name), "snake case, no colons"
    assert kind in TYPES
    assert (kind == "counter") == name.endswith("_total")
    assert not {*words} & {*TYPES, *ABBREVIATED}
    assert words[-1] not in ("bucket", "count", "sum", "info") or name == "lumiloop_info"


def labels_of(latest: Latest) -> list[tuple[str, set[str]]]:
    """Type and labels of each family."""
    found: list[Any] = list(families(exposition(latest, 1.0)))
    return [(family.type, {label for sample in family.samples for label in sample.labels}) for family in found]


def test_labels_that_the_format_reserves_are_where_they_belong() -> None:
    labelled = labels_of(everything())
    assert all(("quantile" in labels) == (kind == "summary") for kind, labels in labelled)
    assert not any("le" in labels or any(label.startswith("__") for label in labels) for _, labels in labelled)
    assert sum(kind == "summary" for kind, _ in labelled) == 3
