"""Every command that stands in a block of code of the documents, and how it is known to do what is said of it."""

import re
import shlex
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).parents[2]
PAGES: Final = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS: Final = ("lumiloop", "python", "make", "mbpoll", "evo_traj", "curl")

RUN: Final = {
    "sessions": (
        r"simulator.md: python -m tools.sim -", r"simulator.md: lumiloop run", r"formats.md: lumiloop run",
        r"replay.md: lumiloop run", r"start-lidar.md: lumiloop run",
    ),
    "beside": (
        r"(start-lidar|troubleshooting|operations).md: lumiloop status", r"(start-lidar|control).md: mbpoll",
        r"view.md: lumiloop view(?! drive)",
        r"formats.md: lumiloop (metrics|foxglove)", r"formats.md: curl", r"stream.md: python tools/clients",
        r"planning.md: lumiloop lamps",
    ),
    "drive": (
        r"replay.md: lumiloop replay (LOG|drive/)", r"replay.md: lumiloop map export drive/",
        r"replay.md: lumiloop why", r"view.md: lumiloop view drive/", r"formats.md: lumiloop export drive",
        r"formats.md: evo_traj",
    ),
    "maps": (
        r"map-files.md: lumiloop map", r"replay.md: lumiloop replay intel",
    ),
    "alone": (
        r"air-interface.md: lumiloop codes", r"simulator.md: python -m tools.sim.(report|building.draw|light.draw)",
        r"bench.md: python -m tools.bench.world --list",
    ),
}  # fmt: skip
"""By test_docs_run.py, a test for each of these; page and beginning of the command, as regular expressions."""

ELSEWHERE: Final = {
    r"fleet.md: lumiloop": "tests/taps/fleet/test_network.py::test_the_commands_of_the_documents",
    r"planning.md: lumiloop plan": "tests/taps/test_docs.py::test_the_plans_of_the_documents",
    r"formats.md: lumiloop export torn": "tests/taps/test_docs.py::test_the_exports_of_the_documents",
    r"installation.md: lumiloop doctor": "tests/taps/test_docs.py::test_the_doctor_of_the_documents",
    r".*: lumiloop probe": "tests/daemon/cli/test_probe.py",
    r"calibration.md: lumiloop (survey|calibrate)": "tests/daemon/commissioning/test_reach.py",
    r".*: make install": "tests/systemd/test_container.py",
    r"README.md: make demo|(start-demo|simulator).md: lumiloop demo|simulator.md: python -m tools.demo": (
        "tests/tools/demo/test_run.py"
    ),
    r"fake-devices.md: (python -m hal.fake --model|lumiloop run)": "tests/daemon/processes/test_process.py",
    r"fake-devices.md: python -m hal.fake.adc.receiver": "tests/hal/fake/adc/test_receiver_process.py",
    r"bench.md: python -m tools.bench.world lap --local": "tests/tools/bench/world/test_world.py",
    r".*: (python -m tools.experiments|make experiments)": "tests/tools/experiments",
    r"data.md: python -m tests.logs": "tests/logs",
    r"README.md: make docs": "tests/tools/docs/test_site.py",
    r"replay.md: lumiloop dump": (
        "tests/daemon/replay/test_recorded_map.py::test_a_dump_is_asked_for_as_the_page_says"
    ),
    r"control.md: lumiloop": "tests/daemon/cli/orders/test_give.py",
    r"map-files.md: lumiloop switch-map": "tests/daemon/cli/orders/test_give.py",
    r"modbus.md: mbpoll": "tests/daemon/publish/test_document.py::test_the_lines_of_mbpoll_give_every_order",
}
"""The test that runs it, or what it is made of where the whole takes minutes, hours, or the devices of a computer."""

NOT_RUN: Final = {
    r"README.md: make test|start-lidar.md: make venv|data.md: make test": "the tests themselves, and what they run in",
    r"bench.md: python -m pytest tests/hil": "needs a lidar, a converter, a robot that moves",
    r"bench.md: python -m tools.bench.world (lap cable|lamps)": "needs a USB gadget, a converter from numbers to light",
    r"bench.md: make bench-vm": "an emulated computer: minutes, and root for the first time",
}
"""Why not."""


def documented(page: Path) -> list[str]:
    """Commands in a page's blocks of code, in their order: without comments, pipes and variables set before them."""
    found, fenced = [], False
    for line in page.read_text().replace("\\\n", "").splitlines():
        fenced = fenced != line.startswith("```")
        if not fenced and not line.startswith("    "):
            continue
        words = re.sub(r"\[(--[^\]]*)\]", r"\1", line.strip())  # what may be left out is there
        words = re.sub(r"^(\$ |sudo |[A-Z_]+=\S+ )+", "", words)
        if words.partition(" ")[0] in PROGRAMS:
            told = shlex.split(words, comments=True)
            ends = [told.index(word) for word in ("|", ">", ">>", "&", "&&", ";") if word in told]
            found.append(shlex.join(told[: min(ends, default=len(told))]))
    return list(dict.fromkeys(found))


def all_documented() -> list[str]:
    """``page: command``, of all pages."""
    return [f"{page.name}: {command}" for page in PAGES for command in documented(page)]


def to_run(how: str) -> list[list[str]]:
    """The words of the commands that a test runs, in the order of the pages."""
    told = [one for one in all_documented() if any(re.match(pattern, one) for pattern in RUN[how])]
    return [shlex.split(one.partition(": ")[2]) for one in told]
