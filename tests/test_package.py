"""What is shipped: every file of ours is in the wheel, and every room in what is installed."""

import re
import tomllib
from fnmatch import fnmatch
from importlib import metadata
from pathlib import Path

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
ROOMS = [name.removesuffix("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"]]
"""Packages of the wheel; of those without a star only the modules directly in them."""
WHOLE = [name.removesuffix("*") for name in PROJECT["tool"]["setuptools"]["packages"]["find"]["include"] if "*" in name]


def files(room: str) -> list[Path]:
    found = (path for path in (ROOT / room.replace(".", "/")).rglob("*") if path.is_file())
    return [path for path in found if "__pycache__" not in path.parts]


def test_every_file_is_in_the_wheel() -> None:
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for room in WHOLE:
        for path in files(room):
            if path.suffix == ".py":
                assert (path.parent / "__init__.py").exists(), f"{path}: its folder is no package"
            else:
                name = str(path.relative_to(ROOT / room))
                assert any(fnmatch(name, pattern) for pattern in data.get(room, ())), (
                    f"{room}/{name} is not in package-data"
                )
    assert any(path.name == "index.html" for path in files("taps"))


def test_the_installer_takes_every_room() -> None:
    (line,) = re.findall(r"^SHIPPED: Final = \((.*)\)", (ROOT / "systemd/environment.py").read_text(), re.MULTILINE)
    assert {room.split(".")[0] for room in ROOMS} <= set(re.findall(r'"(\w+)"', line))
    assert (ROOT / "tools/demo/run.py").exists(), "`lumiloop demo` loads it by name"


def test_locks_have_everything_that_is_named() -> None:
    """Each lock file against the extras and groups that it is made of (`make lock`)."""
    groups = PROJECT["dependency-groups"]
    tools = {name: [one for one in group if isinstance(one, str)] for name, group in groups.items()}
    extras = PROJECT["project"]["optional-dependencies"] | tools
    dev = ["test", "dev", "plot", "images", "mcap", "foxglove", "view", "zenoh"]
    for lock, named in {"core": [], "dev": dev, "bench": [*dev, "bench"]}.items():
        kept = {name_of(row) for row in (ROOT / f"requirements/{lock}.lock").read_text().splitlines()}
        wanted = [*PROJECT["project"]["dependencies"], *(one for extra in named for one in extras[extra])]
        missing = {one for one in wanted if name_of(one) not in kept}
        assert not missing, f"{lock}.lock lacks {missing}"


def test_the_lock_of_the_site_goes_with_that_of_the_tools() -> None:
    """Both are installed into one environment."""

    def versions(lock: str) -> dict[str, str]:
        rows = (ROOT / f"requirements/{lock}.lock").read_text().splitlines()
        return {name_of(row): re.split("[ ;]", row.partition("==")[2])[0] for row in rows if "==" in row}

    site, dev = versions("docs"), versions("dev")
    assert {name_of(one) for one in PROJECT["dependency-groups"]["docs"]} <= set(site)
    assert {name for name in site.keys() & dev if site[name] != dev[name]} == set()


def test_locks_name_the_extras_that_packages_ask_for() -> None:
    """Else pip takes the newest version for the extra, and refuses it for want of a hash, once there is a newer one."""
    rows = [row for row in (ROOT / "requirements/dev.lock").read_text().splitlines() if "==" in row]
    locked = {name_of(row): row.partition("==")[0] for row in rows}
    asked = {
        requirement.partition("]")[0] + "]"
        for one in metadata.distributions()
        if name_of(one.metadata["Name"]) in locked
        for requirement in one.requires or ()
        if re.match(r"[\w.-]+\[", requirement) and "extra ==" not in requirement
    }
    assert "coverage[toml]" in asked
    assert not {one for one in asked if locked.get(name_of(one)) != one}


def name_of(requirement: str) -> str:
    """Its name, as lock files have it."""
    end = next((at for at, letter in enumerate(requirement) if letter in "<>=!~; ["), len(requirement))
    return requirement[:end].lower().replace("_", "-").replace(".", "-")
