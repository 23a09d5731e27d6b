"""Virtual environments of an installation: each is built beside the one in use, and one rename puts it in its place.

    environment.py build      build one from the sources around this file, for `install.sh install`
    environment.py compose    put one together from what the Debian packages have unpacked, for their `postinst`
    environment.py taps OUT   write what the extras add to an installation to OUT, for `package.sh`
    environment.py lay STAGE  put the files below STAGE in their places below DESTDIR, all written before the first
    environment.py check      end with 1 if PREFIX holds anything else
    environment.py remove     remove all environments

Without network, on a full disk, or interrupted at any moment, the environment of before stays in use (`versions`).
Programs that run keep their environment until they end.

Variables: DESTDIR and PREFIX as for `install.sh`. Needs the standard library alone.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.metadata import Distribution, distributions
from pathlib import Path
from typing import Final

from versions import MARK, CannotInstall, Place, lay, place, remove, replace

SOURCE: Final = Path(__file__).resolve().parents[1]
SHIPPED: Final = ("pyproject.toml", "README.md", "LICENSE", "daemon", "hal", "estimator", "taps", "tools")
PACKAGE: Final = ".package"
"""Folder of the environment that the package lumiloop has unpacked; nothing runs from it."""
TAPS: Final = ".taps"
"""Folder of what the package lumiloop-taps adds to it."""
DESK: Final = frozenset({"plot"})
"""Extras for a desk, which the package for robots leaves out."""


def site_of(environment: Path) -> Path | None:
    """Folder of the installed packages; None: there is none."""
    return next(iter(sorted(environment.glob("lib/python3*/site-packages"))), None)


def normal(name: str) -> str:
    """Name of a distribution or a requirement, normalised (PEP 503)."""
    found = re.match(r"[\w.-]+", name.strip())
    return re.sub(r"[-_.]+", "-", found.group().lower()) if found else ""


def installed(site: Path | None) -> dict[str, Distribution]:
    """Installed distributions by name."""
    found = distributions(path=[str(site)]) if site else ()
    return {normal(one.metadata["Name"]): one for one in found if one.metadata["Name"]}


def extras_of(site: Path | None) -> dict[str, list[str]]:
    """Requirements by extra of the lumiloop that is installed there."""
    found = dict[str, list[str]]()
    lumiloop = installed(site).get("lumiloop")
    for line in (lumiloop.requires if lumiloop else None) or ():
        wanted, _, marker = line.partition(";")
        if extra := re.search(r"extra == ['\"]([\w-]+)['\"]", marker):
            found.setdefault(extra.group(1), []).append(wanted.strip())
    return found


def present_extras(site: Path | None) -> list[str]:
    """Extras whose requirements are all installed."""
    there = installed(site)
    return [name for name, wanted in extras_of(site).items() if all(normal(one) in there for one in wanted)]


def build(new: Path, old: Path | None, where: Place) -> None:
    """Build an environment of the sources with their locked packages, and with the extras of the old one."""
    python = Path(os.environ.get("PYTHON") or sys.executable)
    run([python, "-m", "venv", new])
    pip(new, "install", "--no-compile", "--require-hashes", "-r", SOURCE / "requirements/core.lock")
    with tempfile.TemporaryDirectory() as folder:
        for name in SHIPPED:
            if (SOURCE / name).is_dir():
                shutil.copytree(SOURCE / name, Path(folder, name), ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy2(SOURCE / name, folder)
        tools = SOURCE / "requirements/build.txt"
        pip(new, "install", "--no-compile", "--no-deps", folder, constraint=tools)
    site = site_of(new)
    own = sorted(installed(site))
    wanted = [one for name in present_extras(old and site_of(old)) for one in extras_of(site).get(name, ())]
    if wanted:
        with constraints() as pins:
            pip(new, "install", "--no-compile", "-c", pins, *sorted(set(wanted)))
    pip(new, "uninstall", "--yes", "setuptools", "pip")
    strip(new)
    if old:
        carry(old, new, where)
    settle(new, where)
    compiled(python, new / "lib", str(where.root).removesuffix(str(where.prefix)))
    (new / MARK).write_text("\n".join(own) + "\n")


def compose(new: Path, old: Path | None, where: Place) -> None:
    """Put an environment together from the files of the packages, which stay linked to both (link(2))."""
    shutil.copytree(where.versions / PACKAGE, new, symlinks=True, copy_function=link, dirs_exist_ok=True)
    taps = where.versions / TAPS
    if (added := site_of(taps)) and (new / added.relative_to(taps)).is_dir():
        shutil.copytree(taps, new, symlinks=True, copy_function=link, dirs_exist_ok=True)
        own = (new / MARK).read_text() + "\n".join(sorted(installed(added))) + "\n"
        (new / MARK).unlink()  # it is linked to the package's
        (new / MARK).write_text(own)
    if old:
        carry(old, new, where)
    settle(new, where)


def taps(environment: Path, out: Path) -> None:
    """Write to ``out`` what the extras of a robot add to an environment, compiled as it is."""
    with tempfile.TemporaryDirectory() as folder, constraints() as pins:
        maker, more = Path(folder, "maker"), Path(folder, "more")
        run([sys.executable, "-m", "venv", maker])
        shutil.copytree(environment, more, symlinks=True)
        extras = extras_of(site_of(more)).items()
        wanted = sorted({one for name, ones in extras if name not in DESK for one in ones})
        pip(maker, "--python", more / "bin/python", "install", "--no-compile", "-c", pins, *wanted)
        strip(more)
        compiled(Path(sys.executable), more / "lib", folder)
        for path in more.rglob("*"):
            there = path.relative_to(more)
            if (path.is_symlink() or path.is_file()) and not os.path.lexists(environment / there):
                (out / there).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(path, out / there, follow_symlinks=False)


@contextmanager
def constraints() -> Iterator[Path]:
    """The locked versions as pip's constraints, which have neither hashes nor extras."""
    lines = (SOURCE / "requirements/dev.lock").read_text().splitlines()
    pins = [re.sub(r"\[.*?\]", "", line.removesuffix("\\").strip()) for line in lines if line[:1].isalnum()]
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as file:
        file.write("\n".join(pins) + "\n")
        file.flush()
        yield Path(file.name)


def compiled(python: Path, folder: Path, before: str) -> None:
    """Compile a folder to byte code, whose names of files lack the path ``before``; an error costs time at each run."""
    run(
        [python, "-m", "compileall", "-q", "-j", "0", "-s", before, "--invalidation-mode", "checked-hash", folder],
        False,
    )


def strip(new: Path) -> None:
    """Remove what no robot needs."""
    for pattern in ("bin/activate*", "bin/Activate.ps1", "bin/pip*", "bin/wheel", "lib/**/direct_url.json"):
        for path in list(new.glob(pattern)):
            path.unlink()
    for path in [*new.glob("lib/**/tests"), *new.glob("lib/**/__pycache__")]:
        shutil.rmtree(path, ignore_errors=True)


def carry(old: Path, new: Path, where: Place) -> None:
    """Take over what a person has added to the old environment: extras without network, drivers of other lidars."""
    before, after = site_of(old), site_of(new)
    own = set((old / MARK).read_text().split()) if (old / MARK).exists() else set()
    added = {name: one for name, one in installed(before).items() if name not in own | set(installed(after))}
    if not added or before is None or after is None:
        return
    if before.parent.name != after.parent.name:
        say(f"not taken over, because made for another Python: {', '.join(sorted(added))}; install them again")
        return
    for one in added.values():
        for file in one.files or ():
            source, to = Path(os.path.normpath(before / file)), Path(os.path.normpath(after / file))
            if source.is_file() and to.is_relative_to(new) and not to.exists():
                to.parent.mkdir(parents=True, exist_ok=True)
                link(source, to)
    for name in set(present_extras(before)) & set(extras_of(after)):
        if extras_of(before)[name] != extras_of(after)[name]:
            say(f"the extra {name} asks for other versions now ({', '.join(extras_of(after)[name])}); install it again")


def link(source: str | Path, to: str | Path) -> None:
    """Link a file, or copy it where the file system has no links."""
    try:
        os.link(source, to, follow_symlinks=False)
    except OSError as error:
        if error.errno not in (errno.EPERM, errno.EXDEV, errno.EMLINK, errno.EOPNOTSUPP):
            raise
        shutil.copy2(source, to, follow_symlinks=False)


def settle(new: Path, where: Place) -> None:
    """Let the programs of an environment find it where it is seen; their files are linked to no other any more."""
    seen = str(where.seen(new))
    for script in [path for path in (new / "bin").iterdir() if path.is_file() and not path.is_symlink()]:
        line, _, rest = script.read_bytes().partition(b"\n")
        if re.match(rb"#!\S+/bin/python", line):
            rewrite(script, re.sub(rb"#!\S+(/bin/python)", b"#!" + os.fsencode(seen) + rb"\1", line) + b"\n" + rest)
    config = (new / "pyvenv.cfg").read_text().splitlines()
    rewrite(new / "pyvenv.cfg", ("\n".join(one for one in config if not one.startswith("command")) + "\n").encode())


def rewrite(path: Path, content: bytes) -> None:
    """Replace a file by one of the same mode."""
    mode = path.stat().st_mode & 0o777
    path.unlink()
    path.write_bytes(content)
    path.chmod(mode)


def pip(environment: Path, *words: object, constraint: Path | None = None) -> None:
    """Run pip of an environment; ``constraint`` holds for the tools of a build, too."""
    more = {"PIP_CONSTRAINT": str(constraint)} if constraint else {}
    run([environment / "bin/python", "-m", "pip", "--quiet", "--disable-pip-version-check", *words], variables=more)


def run(words: list[object], check: bool = True, variables: dict[str, str] | None = None) -> None:
    """Run a program; `CannotInstall` names the cause if it fails."""
    done = subprocess.run([str(word) for word in words], env={**os.environ, **(variables or {})}, check=False)
    if check and done.returncode:
        name = " ".join(str(word) for word in words[1:5] if not str(word).startswith("/"))
        killed = done.returncode in (-signal.SIGKILL, 128 + signal.SIGKILL)
        why = "was killed, probably for want of memory" if killed else f"ended with {done.returncode}"
        raise CannotInstall(f"`{name}` {why}")


def cause(error: BaseException) -> str:
    """Why an installation failed; a memory limit is named as such."""
    if isinstance(error, KeyboardInterrupt | SystemExit):
        return "interrupted"
    if isinstance(error, MemoryError) or getattr(error, "errno", 0) == errno.ENOMEM:
        return "not enough memory"
    return str(error)


def say(text: str) -> None:
    """Write a line for the person at the terminal."""
    sys.stderr.write(f"lumiloop: {text}\n")


def stopped(number: int, _: object) -> None:
    """End in order at a signal, so that nothing half done is left."""
    raise SystemExit(128 + number)


def main(words: list[str]) -> int:
    """Run one of the orders in the module's text; the exit code."""
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, stopped)
    where = place()
    try:
        if words == ["check"]:
            where.check()
        elif words == ["remove"]:
            remove(where)
        elif words[:1] == ["lay"]:
            lay(Path(words[1]), Path(os.environ.get("DESTDIR") or "/"))
        elif words == ["build"]:
            version = tomllib.loads((SOURCE / "pyproject.toml").read_text())["project"]["version"]
            replace(where, lambda new, old: build(new, old, where), version)
        elif words == ["compose"]:
            unpacked = installed(site_of(where.versions / PACKAGE)).get("lumiloop")
            if unpacked is None:
                raise CannotInstall(f"{where.versions / PACKAGE} is damaged; install the package again")
            version = unpacked.version
            replace(where, lambda new, old: compose(new, old, where), version)
        elif words[:1] == ["taps"]:
            taps(where.root.resolve(), Path(words[1]))
        else:
            raise CannotInstall(f"usage: {Path(__file__).name} build | compose | taps OUT | lay STAGE | check | remove")
    except (CannotInstall, OSError, MemoryError, KeyboardInterrupt, SystemExit) as error:
        kept = f"; the one in {where.root} is unchanged" if where.current else ""
        say(f"{cause(error)}{kept}")
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
