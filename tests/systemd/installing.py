"""An interpreter that plays `venv` and `pip` with small distributions, so that `systemd/install.sh` runs in a second.

Everything else that it is asked for, the scripts of the installation above all, the real interpreter does.
"""

import os
import subprocess
import sys
from pathlib import Path
from typing import Final

SYSTEMD: Final = Path(__file__).parents[2] / "systemd"
SITE: Final = "lib/python3.11/site-packages"
FAKE: Final = r"""#!/usr/bin/env -S {real}
import os, re, shutil, signal, sys
from pathlib import Path
words = sys.argv[1:]
STEPS = ("venv", "pip", "compileall")
if words[:1] != ["-m"] or words[1] not in STEPS:
    os.execv("{real}", ["{real}", *words])
log = Path("{log}")
with log.open("a") as file:
    file.write(" ".join(words) + "\n")
number = len(log.read_text().splitlines())
at, _, how = os.environ.get("SPOIL", "0:").partition(":")
if int(at) == number:
    if how == "kill parent":
        os.kill(os.getppid(), signal.SIGKILL)
    elif how == "kill":
        os.kill(os.getpid(), signal.SIGKILL)
    elif how == "stop parent":
        os.kill(os.getppid(), signal.SIGTERM)
        signal.pause()
    sys.exit("no network")
def put(site, name, requires=(), files=()):
    info = site / (name + "-1.0.dist-info")
    info.mkdir(exist_ok=True)
    lines = ["Name: " + name, "Version: 1.0", *("Requires-Dist: " + one for one in requires)]
    (info / "METADATA").write_text("\n".join(lines) + "\n")
    (site / (name + ".py")).write_text("x = 1\n")
    rows = [name + ".py", info.name + "/METADATA", info.name + "/RECORD", *files]
    (info / "RECORD").write_text("".join(row + ",,\n" for row in rows))
if words[1] == "venv":
    root = Path(words[2])
    (root / "{site}").mkdir(parents=True)
    (root / "bin").mkdir()
    (root / "pyvenv.cfg").write_text("home = /usr/bin\ncommand = " + " ".join(words) + "\n")
    shutil.copy(__file__, root / "bin/python")
    put(root / "{site}", "pip")
elif words[1] == "pip" and "install" in words:
    root = Path(sys.argv[0]).parents[1]
    site = root / "{site}"
    if "-r" in words:
        put(site, "numpy")
    elif "-c" in words:
        for one in words[words.index("-c") + 2:]:
            put(site, re.match(r"[\w-]+", one).group())
    else:
        extras = os.environ.get("EXTRAS", 'aiohttp<4,>=3; extra == "view"|eclipse-zenoh; extra == "zenoh"').split("|")
        put(site, "lumiloop", extras, ["../../../bin/lumiloop"])
        (root / "bin/lumiloop").write_text("#!" + str(root) + "/bin/python\nmain()\n")
        (root / "bin/lumiloop").chmod(0o755)
"""


class Bench:
    """An installation below a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.dest, self.log = folder / "dest", folder / "steps"
        self.python = folder / "python"
        self.python.write_text(
            FAKE.replace("{real}", sys.executable).replace("{log}", str(self.log)).replace("{site}", SITE)
        )
        self.python.chmod(0o755)
        self.root, self.versions = self.dest / "opt/lumiloop", self.dest / "opt/lumiloop-versions"

    @property
    def steps(self) -> list[str]:
        """Steps of `venv`, `pip` and `compileall` that were asked for since the last order."""
        return self.log.read_text().splitlines()

    @property
    def places(self) -> dict[str, str]:
        """Variables of an order."""
        own = {"DESTDIR": str(self.dest), "PREFIX": "/opt/lumiloop", "PYTHON": str(self.python)}
        return {**os.environ, **own, "TMPDIR": str(self.dest.parent)}

    def order(self, *words: str, script: str = "install.sh", **more: str) -> subprocess.CompletedProcess[str]:
        """Run one of the scripts."""
        self.log.write_text("")
        starter = [sys.executable] if script.endswith(".py") else []
        command = [*starter, str(SYSTEMD / script), *words]
        return subprocess.run(command, env=self.places | more, capture_output=True, text=True, timeout=60.0)

    def changed(self, code: str, *words: str, **more: str) -> subprocess.CompletedProcess[str]:
        """Run an order of environment.py after ``code`` has changed its modules."""
        self.log.write_text("")
        program = f"import sys; sys.path.insert(0, {str(SYSTEMD)!r}); import environment, versions\n{code}\n"
        command = [sys.executable, "-B", "-c", f"{program}sys.exit(environment.main(list({words})))"]
        return subprocess.run(command, env=self.places | more, capture_output=True, text=True, timeout=60.0)

    def add(self, name: str) -> None:
        """What ``pip --python /opt/lumiloop/bin/python install NAME`` leaves."""
        command = [self.root.resolve() / "bin/python", "-m", "pip", "install", "-c", "pins", name]
        subprocess.run(command, check=True)

    def has(self, name: str) -> bool:
        """Whether a distribution is installed in the environment in use, with its file."""
        return all((self.root / SITE / one).exists() for one in (f"{name}.py", f"{name}-1.0.dist-info"))

    def kept(self) -> list[str]:
        """Names of all environments."""
        return sorted(path.name for path in self.versions.iterdir() if path.name[0] != ".")

    def listing(self) -> dict[str, bytes]:
        """Content of each file of the environment in use."""
        folder = self.root.resolve()
        return {str(path): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


KILLED: Final = """
import os, runpy, sys
calls, last = 0, int(sys.argv.pop(1))
FILES = ("open", "os.rename", "os.symlink", "os.mkdir", "os.remove", "os.rmdir", "os.link", "subprocess.Popen")
def watch(event, arguments):
    global calls
    if event in FILES and not (event == "open" and not (arguments[2] or 0) & 3):
        calls += 1
        if calls == last:
            os._exit(9)
sys.argv = sys.argv[1:]
sys.path.insert(0, os.path.dirname(sys.argv[0]))
sys.addaudithook(watch)
try:
    runpy.run_path(sys.argv[0], run_name="__main__")
finally:
    if not last:
        print(calls)
"""
"""Runs a script and ends it, as a power cut or SIGKILL, before its n-th change of a file."""


def killed(bench: Bench, script: Path, order: str, at: int) -> subprocess.CompletedProcess[str]:
    """Run an order of a script and end it at a call; 0: never, and it prints how many calls there were."""
    command = [sys.executable, "-B", "-c", KILLED, str(at), str(script), order]
    done = subprocess.run(command, env=bench.places, capture_output=True, text=True, timeout=60.0)
    assert done.returncode == 9 if at else done.returncode == 0, done.stderr
    return done
