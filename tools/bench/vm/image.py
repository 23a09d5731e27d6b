"""The emulated computer's disk: Debian with its kernel, the package as it is shipped, and the bench's own few files.

Two steps, each kept: the base (Debian, the kernel module, the initial RAM disk; some minutes, once) and the image (the
base with the package of these sources and its kernels compiled for any processor). No loop device, and no mount that
others see: the file system is made from a folder.
"""

import contextlib
import hashlib
import json
import lzma
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from tools.bench.support.children import LEASH
from tools.bench.vm.places import CannotBench, cache, clear, discard, held, missing, missing_of, workspace

ROOT = Path(__file__).parents[3]
GUEST = Path(__file__).parent / "guest"
SUITE = "bookworm"
PACKAGES = ("systemd", "systemd-sysv", "udev", "python3", "kmod", "iproute2", "linux-image-amd64")
ONLY_TO_BUILD = ("linux-headers-amd64", "gcc", "make")
SMALL_RAM_DISK = "MODULES=list\nCOMPRESS=lz4\n"
IN_RAM_DISK = "virtio_pci\nvirtio_blk\next4\n"
INIT_HOOK = '#!/bin/sh\n[ "$1" = prereqs ] || cp /usr/share/bench/init "$DESTDIR/bench-init"\n'
"""Of initramfs-tools: puts `guest/init` beside Debian's own, and QEMU's command line says which one runs."""
UNUSED = (
    "gpu",
    "net/wireless",
    "net/ethernet",
    "media",
    "infiniband",
    "scsi",
    "staging",
    "iio",
    "isdn",
    "mtd",
    "hwmon",
)
"""Below drivers/ of the kernel's modules: three quarters of them."""
CACHE_PLACE = Path("var/cache/private/lumiloop")
WARM = {"NUMBA_CPU_NAME": "generic", "NUMBA_ENABLE_AVX": "0", "PYTHONPATH": str(ROOT)}
"""As `guest/generic.conf` says inside: numba's settings name the kernels' folder."""
DISK_BYTES = 3_000_000_000
ROOM = 5_000_000_000
BUILD_S = 1800.0
APART = ("unshare", "--mount", "--pid", "--fork", "--kill-child", "--")
"""Before the words of a step that starts others and mounts: all that ends with the step. mmdebstrap binds /dev/shm into
what it makes, and what it has made is removed when a run is broken off."""
XZ, ELF = b"\xfd7zXZ\x00", b"\x7fELF"
Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class Image:
    """What QEMU starts from: the disk, the kernel, the initial RAM disk."""

    folder: Path

    @property
    def disk(self) -> Path:
        """An ext4 file system without partitions; never written to."""
        return self.folder / "disk"

    @property
    def kernel(self) -> Path:
        """Debian's, unpacked."""
        return self.folder / "vmlinux"

    @property
    def initrd(self) -> Path:
        """With what it takes to find the disk."""
        return self.folder / "initrd"

    def lacks(self) -> str:
        """What is missing or empty; empty text: it is whole."""
        return missing_of(self.parts)

    @property
    def parts(self) -> tuple[Path, ...]:
        """All three."""
        return self.disk, self.kernel, self.initrd


def discard_parts(say: Say) -> None:
    """Remove what a making or a first boot that was killed has left half done in the cache.

    Before this process makes anything, what bears its number is of one that had it before.
    """
    for left in (*cache().glob("part-*"), *cache().glob("image-*/part-*")):
        number = left.name.removeprefix("part-").partition(".")[0]
        if number == str(os.getpid()) or not Path("/proc", number).exists():
            say(f"removing {left}: left half done by a process that was ended")
            shutil.rmtree(left, ignore_errors=True)
            with contextlib.suppress(OSError):  # it is gone with that; or of another user, and who may read still runs
                left.unlink()


def digest(*paths: Path, extra: str = "") -> str:
    """Of files, and of all files below folders."""
    made = hashlib.sha256(extra.encode())
    for path in paths:
        for file in sorted([path] if path.is_file() else path.rglob("*")):
            if file.is_file() and "__pycache__" not in file.parts:
                made.update(str(file.relative_to(ROOT)).encode() + b"\0" + file.read_bytes())
    return made.hexdigest()[:16]


def base_key() -> str:
    """What the base depends on."""
    recipe = json.dumps([SUITE, PACKAGES, ONLY_TO_BUILD, SMALL_RAM_DISK, IN_RAM_DISK, INIT_HOOK, UNUSED])
    return digest(GUEST / "fakei2c.c", GUEST / "Kbuild", GUEST / "init", extra=recipe)


def image_key() -> str:
    """What the image depends on."""
    parts = ("daemon", "hal", "estimator", "taps", "systemd", "requirements/core.lock", "pyproject.toml")
    return digest(*(ROOT / part for part in parts), GUEST, Path(__file__), extra=base_key())


@contextlib.contextmanager
def image(say: Say) -> Iterator[Image]:
    """The image of these sources, made where it is not there yet; until the end nobody else removes it.

    Another checkout may have made one of its own, and want to remove this one, before it is held: then once more.

    Raises:
        CannotBench: something is missing, or a step failed; says what.
    """
    made = Image(cache() / f"image-{image_key()}")
    discard_parts(say)
    with contextlib.ExitStack() as stack:
        _see_to(made, say)
        try:
            stack.enter_context(held(made.folder))
        except FileNotFoundError:
            _see_to(made, say)
            stack.enter_context(held(made.folder))
        yield made


def _see_to(made: Image, say: Say) -> None:
    """Make it where it is not there, or not whole; others that nobody uses go then."""
    if made.folder.exists() and (lacks := made.lacks()):
        clear(made.folder, lacks)
        say(f"{made.folder} was not whole ({lacks}): it is made anew")
    if reason := missing(build=not made.folder.exists()):
        raise CannotBench(reason)
    if not made.folder.exists():
        begun = time.monotonic()
        with workspace("lumiloop-vm-image", ROOM) as folder:
            _make_image(folder, made, say)
        say(f"image made in {time.monotonic() - begun:.0f} s")
        for old in cache().glob("image-*"):
            if old != made.folder and not discard(old):
                say(f"{old} stays: another run uses it, or it is of another user")


_running: set[subprocess.Popen[str]] = set()
"""Steps, of all threads."""


def _do(words: list[str], what: str, environment: dict[str, str] | None = None, apart: bool = False) -> str:
    """Run a step, which ends when this does, however that ends; what it wrote. ``apart``: see :data:`APART`."""
    with subprocess.Popen(
        [*LEASH, *(APART if apart and _may_be_apart() else ()), *words],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "DEBIAN_FRONTEND": "noninteractive", **(environment or {})},
    ) as step:  # fmt: skip
        _running.add(step)
        try:
            said = step.communicate(timeout=BUILD_S)[0]
        except subprocess.TimeoutExpired as error:
            raise CannotBench(f"{what} has not ended within {BUILD_S:.0f} s") from error
        finally:
            _running.discard(step)
            step.kill()
    if step.returncode:
        raise CannotBench(f"{what} failed with {step.returncode}:\n{said[-4000:]}")
    return said


def _may_be_apart() -> bool:
    """Where this is not allowed, nothing can be mounted either."""
    return subprocess.run([*APART, "true"], capture_output=True).returncode == 0


def base(say: Say) -> Path:
    """Debian as a tar, with the module built for its kernel; made where it is not there yet."""
    tar = cache() / f"base-{base_key()}.tar"
    if tar.exists():
        return tar
    cache().mkdir(parents=True, exist_ok=True)
    say("making the base system, which takes some minutes")
    part = tar.with_name(f"part-{os.getpid()}.tar")
    with workspace("lumiloop-vm-base", ROOM) as folder:
        hooks = _hooks(folder)
        command = [
            "mmdebstrap", "--variant=minbase", f"--include={','.join((*PACKAGES, 'initramfs-tools', *ONLY_TO_BUILD))}",
            *(f"--customize-hook={hook}" for hook in hooks), SUITE, str(part),
        ]  # fmt: skip
        try:
            _do(command, "making the base system", {"TMPDIR": str(folder)}, apart=True)
            part.replace(tar)
        finally:
            part.unlink(missing_ok=True)
    for old in cache().glob("base-*"):
        if old != tar:
            old.unlink()
    return tar


def _hooks(folder: Path) -> list[str]:
    """What is done to the base once its packages are there ("$1": its root)."""
    (folder / "initramfs").write_text(SMALL_RAM_DISK)
    (folder / "modules").write_text(IN_RAM_DISK)
    (folder / "hook").write_text(INIT_HOOK)
    module = "/usr/src/fakei2c"
    inside = 'chroot "$1" sh -e -c'
    modules = "/lib/modules/$(basename /lib/modules/*-amd64)"
    unused = " ".join(f"{modules}/kernel/{part}" for part in (*(f"drivers/{part}" for part in UNUSED), "sound"))
    return [
        f'mkdir -p "$1{module}" && cp {GUEST}/fakei2c.c {GUEST}/Kbuild "$1{module}"',
        f"{inside} 'make -s -C {modules}/build M={module} modules'",
        f"{inside} 'install -D -t {modules}/updates {module}/fakei2c.ko && rm -rf {module}'",
        f"{inside} 'apt-get purge -q -y {' '.join(ONLY_TO_BUILD)} && apt-get autoremove -q -y --purge'",
        f"{inside} 'rm -rf {unused} && depmod -a $(basename {modules})'",
        f'cp {folder}/initramfs "$1/etc/initramfs-tools/conf.d/bench"',
        f'cp {folder}/modules "$1/etc/initramfs-tools/modules"',
        f'install -D -m 755 {GUEST}/init "$1/usr/share/bench/init"',
        f'install -m 755 {folder}/hook "$1/etc/initramfs-tools/hooks/bench"',
        f"{inside} 'update-initramfs -u'",
    ]


def _make_image(folder: Path, made: Image, say: Say) -> None:
    cache().mkdir(parents=True, exist_ok=True)
    root = folder / "root"
    with ThreadPoolExecutor(1) as beside:  # the one takes a processor, the other mostly the network and the disk
        kernels = beside.submit(_compile, say)
        try:
            _install(folder, root, say)
            plant(root, kernels.result())
        except BaseException:
            while not kernels.done():
                for step in tuple(_running):
                    step.kill()
                time.sleep(0.02)
            raise
    part = made.folder.with_name(f"part-{os.getpid()}")
    try:
        part.mkdir(parents=True)
        packed, initrd = (max((root / "boot").glob(f"{name}*-*")) for name in ("vmlinuz", "initrd"))
        (part / "vmlinux").write_bytes(unpacked(packed.read_bytes()))
        shutil.copy(initrd, part / "initrd")
        say("making the disk")
        with (part / "disk").open("wb") as disk:
            disk.truncate(DISK_BYTES)
        path = f"{os.environ.get('PATH', '')}:/usr/sbin:/sbin"
        _do(["mkfs.ext4", "-q", "-F", "-d", str(root), str(part / "disk")], "making the disk", {"PATH": path})
        part.replace(made.folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _install(folder: Path, root: Path, say: Say) -> None:
    """Debian with the package and the bench's own files, below ``root``."""
    tar = base(say)
    say("packing the daemon")
    pack = [str(ROOT / "systemd/package.sh"), str(folder / "package")]
    said = _do(pack, "making the package", {"TMPDIR": str(folder)}, apart=True)
    package = said.split()[-1]
    root.mkdir()
    _do(["tar", "-C", str(root), "-xf", str(tar)], "unpacking the base system")
    shutil.copy(package, root / "package.deb")
    _do(["chroot", str(root), "dpkg", "-i", "/package.deb"], "installing the package")
    (root / "package.deb").unlink()
    _furnish(root)


def unpacked(kernel: bytes) -> bytes:
    """The ELF file that Debian's boot image carries and would unpack at each boot, which takes three seconds there.

    Raises:
        CannotBench: there is none in it.
    """
    begins, unpack = kernel.find(XZ), lzma.LZMADecompressor()
    with contextlib.suppress(lzma.LZMAError):
        made = unpack.decompress(kernel[begins:]) if begins >= 0 else b""
        if unpack.eof and made.startswith(ELF):
            return made
    raise CannotBench("the kernel's boot image holds no kernel packed by xz")


def _furnish(root: Path) -> None:
    """The bench's own files."""
    places = {
        "agent.py": "usr/lib/bench/agent.py",
        "bench-agent.service": "etc/systemd/system/bench-agent.service",
        "bench-network.service": "etc/systemd/system/bench-network.service",
        "generic.conf": "etc/systemd/system/lumiloop.service.d/generic.conf",
        "lumiloop.toml": "etc/lumiloop/lumiloop.toml",
    }
    for name, place in places.items():
        (root / place).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(GUEST / name, root / place)
    warm_up = root / "etc/systemd/system/lumiloop-warmup.service.d"
    warm_up.mkdir()
    shutil.copy(GUEST / "generic.conf", warm_up)
    (root / "etc/hostname").write_text("robot\n")
    (root / "var/log/journal").mkdir(exist_ok=True)
    _do(["chroot", str(root), "systemctl", "enable", "-q", "bench-agent", "bench-network"], "enabling units")
    timers = ["apt-daily.timer", "apt-daily-upgrade.timer", "e2scrub_all.timer", "fstrim.timer", "dpkg-db-backup.timer"]
    _do(["chroot", str(root), "systemctl", "mask", "-q", *timers, "e2scrub_reap.service"], "masking timers")


def copy_kernels(compiled: Path, place: Path) -> None:
    """Copy the kernels of every package of the estimator; they serve wherever it is installed."""
    for package in compiled.glob("*_estimator"):
        shutil.copytree(package, place / package.name)


def _compile(say: Say) -> Path:
    """Compile the kernels for any processor; returns their folder."""
    say("compiling kernels for any processor")
    warm = [sys.executable, "-m", "daemon", "warm", "--config", str(GUEST / "lumiloop.toml")]
    _do([*warm, "--set", "photodiode.bus=adapter:bench"], "compiling kernels", WARM)
    where = "from estimator.numerics.jit_cache import CACHE_DIR; print(CACHE_DIR)"
    return Path(_do([sys.executable, "-c", where], "finding the kernels", WARM).split()[-1])


def plant(root: Path, compiled: Path) -> None:
    """Put the kernels that have been compiled out here where the installation looks for its own.

    The marks of an earlier start are left there too, so that the next one need not warm up: who wants a first start
    takes them away.
    """
    place = root / CACHE_PLACE / compiled.name
    copy_kernels(compiled, place)
    mark = "from daemon.runtime import warmup; print(warmup.mark_of({!r}).name)"
    for what in ("warm", "warm-lights"):
        named = _do([sys.executable, "-c", mark.format(what)], "naming the marks", WARM)
        (place / named.split()[-1]).touch()
    (root / CACHE_PLACE).parent.chmod(0o700)
