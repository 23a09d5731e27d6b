"""Scenario: the package is removed, which is the last that happens to a computer."""

from __future__ import annotations

from typing import Final

from tools.bench.vm.bench import CONFIG, UNIT, Bench
from tools.bench.vm.common import need, scenario

INSTALLED: Final = ("/opt/lumiloop", "/usr/bin/lumiloop", f"/usr/lib/systemd/system/{UNIT}", "/usr/share/doc/lumiloop")
OWN: Final = (CONFIG, "/var/lib/lumiloop")
KEPT: Final = ("/etc/lumiloop", "/var/lib/private/lumiloop", "/var/cache/lumiloop", "/var/cache/private/lumiloop")


@scenario("gone")
def is_removed(bench: Bench) -> str:
    """`dpkg --remove` leaves configuration and maps, `--purge` nothing."""
    bench.machine.run("dpkg", "--remove", "lumiloop", seconds=120)
    need(bench.machine.run("systemctl", "is-active", UNIT, check=False).strip() != "active", "it still runs")
    need(not (left := _there(bench, *INSTALLED)), f"of the programs are left: {left}")
    need(_there(bench, *OWN) == list(OWN), "configuration or maps have gone")
    bench.machine.run("dpkg", "--purge", "lumiloop", seconds=120)
    need(not (left := _there(bench, *INSTALLED, *OWN, *KEPT)), f"are left: {left}")
    return "nothing is left"


def _there(bench: Bench, *paths: str) -> list[str]:
    """Which of these are there."""
    return bench.machine.run("sh", "-c", f"ls -d {' '.join(paths)} 2>/dev/null", check=False).split()
